"""Thin the surfaces of a cloud: move each point to the plane of its neighbours, within its uncertainty."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.bands import for_bands
from pano_mvs.scene import PointCloud

IntArray = NDArray[np.int64]

_PASSES = 2
# Neighbours count within this many standard deviations of the point's position.
_REACH = 2.0
# Larger standard deviations, relative to the distance of the nearest camera, reach no farther.
_MOST_UNCERTAIN = 0.03
_POINTS_PER_COLUMN = 12
_POINTS_AT_ONCE = 1 << 14
# Points with a smaller standard deviation, relative to the same distance, stay where they are.
_LEAST_UNCERTAIN = 0.005
_MAX_LEVELS, _MAX_CELLS_PER_AXIS = 16, 1 << 20


def smooth_surfaces(cloud: PointCloud, centers: FloatArray, *, threads: int = 1) -> PointCloud:
    """Return a cloud whose points are moved along their normals towards the planes of their neighbours.

    Views put the same wall at different distances, so that it becomes a slab of the thickness of their errors. The
    plane at a point is fitted to the points within twice its standard deviation σ that have a similar normal and whose
    distance from it can be explained by both uncertainties, weighted by their precision. In each of two passes, the
    point moves by the height of the plane, at most by σ/2. σ is at most 3 % of the distance of the nearest camera.
    Points with less than 0.5 %, and points whose neighbours are few or all on one side, stay where they are.

    `cloud`: N points of one group; unchanged if it has no uncertainty. `centers`: (M, 3) camera centres in the world.
    `threads`: number of threads; the result does not depend on it.
    """
    if cloud.uncertainty is None or len(cloud) == 0:
        return cloud
    points, normals = np.ascontiguousarray(cloud.points_in_world), np.ascontiguousarray(cloud.normals_in_world)
    distances = np.asarray(cKDTree(centers).query(points)[0], np.float32)
    sigmas = np.maximum(np.minimum(cloud.uncertainty, _MOST_UNCERTAIN * distances), np.float32(1e-12))
    chosen = np.flatnonzero(sigmas >= _LEAST_UNCERTAIN * distances)
    most = sigmas / _PASSES
    for _ in range(_PASSES):
        heights = surface_heights(points, normals, sigmas, chosen=chosen, threads=threads)
        points = (points + np.clip(heights, -most, most)[:, None] * normals).astype(np.float32)
    return replace(cloud, points_in_world=points)


def surface_heights(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    sigmas: NDArray[np.float32],
    *,
    chosen: IntArray | None = None,
    per_column: int = _POINTS_PER_COLUMN,
    threads: int = 1,
) -> FloatArray:
    """Return the heights (N,) along their normals of the planes of their neighbours above points; 0 if undefined.

    `points`: (N, 3), N ≥ 1. `normals`: (N, 3) unit vectors. `sigmas`: (N,) standard deviations, positive. `chosen`:
    indices of the points whose heights are wanted; those of others are 0. None: all. `per_column`: of each of the 9
    columns of three cells around a point, this many points count; the edge of a cell is at least the reach of the
    point. `threads`: as in `smooth_surfaces`.
    """
    from pano_mvs.algorithms.fusion.kernels_smooth import find_heights  # compiles on import

    radii = _REACH * sigmas.astype(np.float64)
    heights = np.zeros(len(points))
    wanted = np.arange(len(points)) if chosen is None else chosen
    cloud = points, normals, sigmas
    marked = np.zeros(len(points), np.bool_)
    for some, edge in _levels(points, radii, wanted):
        cells = _cells(points, float(edge))
        marked[some] = True
        targets = np.flatnonzero(marked[cells[-1]])
        marked[some] = False

        def find(first: int, count: int, *, targets: IntArray = targets, cells: tuple[IntArray, ...] = cells) -> None:
            find_heights(cloud, radii, targets, cells, per_column, heights, (first, first + count))

        for_bands(find, len(targets), threads=threads, band_rows=_POINTS_AT_ONCE)
    return heights


def _levels(points: NDArray[np.float32], radii: FloatArray, wanted: IntArray) -> list[tuple[IntArray, float]]:
    """Return the wanted points of each level, and the edge of its cells, which is not smaller than their radii."""
    if not len(wanted):
        return []
    extent = float((points.max(axis=0) - points.min(axis=0)).max())
    most = float(radii[wanted].max()) / 2 ** (_MAX_LEVELS - 1)
    least = max(float(np.quantile(radii[wanted], 0.3)), most, extent / _MAX_CELLS_PER_AXIS)
    level = np.ceil(np.log2(np.maximum(radii[wanted] / least, 1))).astype(np.int64)
    return [(wanted[level == number], least * 2.0**number) for number in np.unique(level)]


def _cells(points: NDArray[np.float32], edge: float) -> tuple[IntArray, ...]:
    """Return the cells of this edge, as `find_heights` needs them; the last array is the order of the points."""
    from pano_mvs.algorithms.fusion.kernels_smooth import find_cells, find_starts, sort_keys  # compile on import

    # One axis at a time: columns of a large (N, 3) array are slow to reduce.
    extents = [(axis.min(), axis.max()) for axis in np.ascontiguousarray(points.T)]
    least, most = np.array(extents, np.float32).T
    shape = np.floor((most - least).astype(np.float64) / edge).astype(np.int64) + 3
    own, order = sort_keys(find_cells(points, least, edge, shape), int(np.prod(shape)))
    keys, starts = find_starts(own)
    steps = np.array(list(product((-1, 0, 1), repeat=2)), np.int64) @ np.array([shape[1] * shape[2], shape[2]])
    return keys, starts, own, steps, order
