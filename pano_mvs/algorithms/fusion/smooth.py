"""Thin the surfaces of a cloud: move each point to the plane of its neighbours, within its uncertainty."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.bands import for_bands
from pano_mvs.scene import PointCloud

IntArray = NDArray[np.int64]

_PASSES = 2
# Neighbours count within this many standard deviations of the point's position.
_REACH = 2.0
# Points that are sorted into cells together, and those that are moved together: they bound the memory.
_POINTS_OF_PART = 1_000_000


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
    tree, distances = scipy.spatial.cKDTree(centers), np.empty(len(points), np.float32)
    for part in _parts(len(points)):
        distances[part] = tree.query(points[part])[0]
    # Larger standard deviations, relative to the distance of the nearest camera, reach no farther.
    sigmas = np.maximum(np.minimum(cloud.uncertainty, 0.03 * distances), np.float32(1e-12))
    # Points with a smaller standard deviation, relative to the same distance, stay where they are.
    chosen = sigmas >= 0.005 * distances
    del distances
    for _ in range(_PASSES):
        heights = surface_heights(points, normals, sigmas, chosen=chosen, threads=threads)
        moved = np.empty_like(points)
        for part in _parts(len(points)):
            most = sigmas[part] / _PASSES
            step = np.clip(heights[part], -most, most)
            moved[part] = points[part] + step[:, None] * normals[part]
        points = moved
    return replace(cloud, points_in_world=points)


def surface_heights(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    sigmas: NDArray[np.float32],
    *,
    chosen: NDArray[np.bool_] | None = None,
    per_column: int = 12,
    points_of_slab: int = 2_000_000,
    threads: int = 1,
) -> FloatArray:
    """Return the heights (N,) along their normals of the planes of their neighbours above points; 0 if undefined.

    `points`: (N, 3), N ≥ 1. `normals`: (N, 3) unit vectors. `sigmas`: (N,) standard deviations, positive. `chosen`:
    (N,) the points whose heights are wanted; those of others are 0. None: all. `per_column`: of each of the 9
    columns of three cells around a point, this many points count; the edge of a cell is at least the reach of the
    point. `points_of_slab`: number of points that are sorted together, or those around a layer of cells; the result
    does not depend on it. `threads`: as in `smooth_surfaces`.
    """
    from pano_mvs.algorithms.fusion.kernels_smooth import find_heights  # compiles on import

    heights = np.zeros(len(points))
    grid = _extent(points)
    edges, levels = _levels(grid, sigmas, np.ones(len(points), np.bool_) if chosen is None else chosen)
    for level, edge in edges.items():
        for own, around in _slabs(points, float(grid[0][0]), edge=edge, most=points_of_slab):
            cloud = points[around], normals[around], sigmas[around]
            radii, found = _REACH * cloud[2].astype(np.float64), np.zeros(len(cloud[0]))
            cells = _cells(cloud[0], grid, edge)
            own = own & (levels[around] == level)
            targets = np.flatnonzero(own[cells[-1]])

            def find(
                first: int,
                count: int,
                *,
                targets: IntArray = targets,
                cells: tuple[IntArray, ...] = cells,
                cloud: tuple[NDArray[np.float32], ...] = cloud,
                arrays: tuple[FloatArray, FloatArray] = (radii, found),
            ) -> None:
                find_heights(cloud, arrays[0], targets, cells, per_column, arrays[1], (first, first + count))

            for_bands(find, len(targets), threads=threads, band_rows=1 << 14)
            heights[around] = np.where(own, found, heights[around])
    return heights


def _slabs(
    points: NDArray[np.float32], least: float, *, edge: float, most: int
) -> Iterator[tuple[NDArray[np.bool_], IntArray | slice]]:
    """Yield the points of slabs of cells and the next cells on either side, and which of them are in the slab."""
    if len(points) <= most:
        yield np.ones(len(points), np.bool_), slice(None)
        return
    layers = np.empty(len(points), np.int32)
    for part in _parts(len(points)):
        layers[part] = np.floor((points[part, 0] - np.float32(least)) / edge)  # as in `find_cells`
    counts = np.bincount(layers)
    first, before = 0, np.concatenate([[0], np.cumsum(counts)])
    while first < len(counts):
        end = first + 1
        while end < len(counts) and before[min(end + 2, len(counts))] - before[max(first - 1, 0)] <= most:
            end += 1
        around = np.flatnonzero((layers >= first - 1) & (layers <= end))
        here = layers[around]
        yield (here >= first) & (here < end), around
        first = end


Extent = tuple[NDArray[np.float32], NDArray[np.float32]]


def _extent(points: NDArray[np.float32]) -> Extent:
    """Return the least and the largest coordinates, (3,) each."""
    # One axis at a time: columns of a large (N, 3) array are slow to reduce.
    columns = (np.ascontiguousarray(points[:, axis]) for axis in range(3))
    least, most = np.array([(column.min(), column.max()) for column in columns], np.float32).T
    return least, most


def _levels(
    grid: Extent, sigmas: NDArray[np.float32], wanted: NDArray[np.bool_]
) -> tuple[dict[int, float], NDArray[np.int8]]:
    """Return the edge of the cells of each level, at least the radii of its points, and the level of each point.

    Points that are not wanted, (N,), have level −1.
    """
    levels = np.full(len(sigmas), -1, np.int8)
    if not wanted.any():
        return {}, levels
    radii = _REACH * sigmas[wanted].astype(np.float64)
    extent = float((grid[1] - grid[0]).max())
    most = float(radii.max()) / 2**15
    least = max(float(np.quantile(radii, 0.3)), most, extent / (1 << 20))
    del radii
    for part in _parts(len(sigmas)):
        level = np.ceil(np.log2(np.maximum(_REACH * sigmas[part].astype(np.float64) / least, 1))).astype(np.int8)
        levels[part] = np.where(wanted[part], level, np.int8(-1))
    return {int(level): least * 2.0 ** int(level) for level in np.unique(levels) if level >= 0}, levels


def _parts(count: int) -> Iterator[slice]:
    """Yield parts of an array of this many points."""
    for first in range(0, count, _POINTS_OF_PART):
        yield slice(first, first + _POINTS_OF_PART)


def _cells(points: NDArray[np.float32], grid: Extent, edge: float) -> tuple[IntArray, ...]:
    """Return the cells of this edge, as `find_heights` needs them; the last array is the order of the points."""
    from pano_mvs.algorithms.fusion.kernels_smooth import find_cells, find_starts, sort_keys  # compile on import

    least, most = grid
    shape = np.floor((most - least).astype(np.float64) / edge).astype(np.int64) + 3
    own, order = sort_keys(find_cells(points, least, edge, shape), int(np.prod(shape)))
    keys, starts = find_starts(own)
    steps = np.array(list(product((-1, 0, 1), repeat=2)), np.int64) @ np.array([shape[1] * shape[2], shape[2]])
    return keys, starts, own, steps, order
