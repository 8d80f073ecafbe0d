"""Thin the surfaces of a cloud: move each point to the plane of its neighbours, within its uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.core.bands import for_bands
from pano_mvs.scene import PointCloud

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Neighbours count within this many standard deviations of the point's position, and no point moves by more than this
# many in one pass.
_REACH, _MAX_MOVE = 2.0, 0.5
# Larger standard deviations, relative to the distance of the nearest camera, reach no farther.
_MOST_UNCERTAIN = 0.03
_PASSES = 2
_POINTS_PER_CELL = 8
_MAX_LEVELS, _MAX_CELLS_PER_AXIS = 16, 1 << 20


def smooth_surfaces(cloud: PointCloud, centers: FloatArray, *, threads: int = 1) -> PointCloud:
    """Return a cloud whose points are moved along their normals towards the planes of their neighbours.

    Views put the same wall at different distances, so that it becomes a slab of the thickness of their errors. The
    plane at a point is fitted to the points within twice its standard deviation σ that have a similar normal and whose
    distance from it can be explained by both uncertainties, weighted by their precision. In each of two passes, the
    point moves by the height of the plane, at most by σ/2. σ is at most 3 % of the distance of the nearest camera.
    Points whose neighbours are few or all on one side stay where they are.

    Args:
        cloud: N points of one group; unchanged if it has no uncertainty.
        centers: (M, 3) camera centres in the world.
        threads: number of threads; the result does not depend on it.
    """
    if cloud.uncertainty is None or len(cloud) == 0:
        return cloud
    points, normals = np.ascontiguousarray(cloud.points_in_world), np.ascontiguousarray(cloud.normals_in_world)
    distances = np.asarray(cKDTree(centers).query(points)[0], np.float32)
    sigmas = np.maximum(np.minimum(cloud.uncertainty, _MOST_UNCERTAIN * distances), np.float32(1e-12))
    for _ in range(_PASSES):
        moves = np.clip(
            surface_heights(points, normals, sigmas, threads=threads), -_MAX_MOVE * sigmas, _MAX_MOVE * sigmas
        )
        points = (points + moves[:, None] * normals).astype(np.float32)
    return replace(cloud, points_in_world=points)


def surface_heights(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    sigmas: NDArray[np.float32],
    *,
    per_cell: int = _POINTS_PER_CELL,
    threads: int = 1,
) -> FloatArray:
    """Return the heights (N,) along their normals of the planes of their neighbours above points; 0 if undefined.

    Args:
        points: (N, 3), N ≥ 1.
        normals: (N, 3) unit vectors.
        sigmas: (N,) standard deviations, positive.
        per_cell: of each of the 27 cells around a point, whose edge is at least its reach, this many points count.
        threads: as in `smooth_surfaces`.
    """
    from pano_mvs.algorithms.fusion.kernels_smooth import find_heights  # compiles on import

    radii = _REACH * sigmas.astype(np.float64)
    heights = np.zeros(len(points))
    for chosen, edge in _levels(points, radii):
        arguments = (points, normals, sigmas), radii, chosen, _cells(points, edge), per_cell, heights
        for_bands(partial(_find, find_heights, arguments), len(chosen), threads=threads)
    return heights


def _find(kernel: Callable[..., object], arguments: tuple[object, ...], first: int, count: int) -> None:
    kernel(*arguments, (first, first + count))


def _levels(points: NDArray[np.float32], radii: FloatArray) -> list[tuple[IntArray, float]]:
    """Return the points of each level and the edge of its cells, which is not smaller than their radii."""
    extent = float((points.max(axis=0) - points.min(axis=0)).max())
    least = max(
        float(np.quantile(radii, 0.05)), float(radii.max()) / 2 ** (_MAX_LEVELS - 1), extent / _MAX_CELLS_PER_AXIS
    )
    level = np.ceil(np.log2(np.maximum(radii / least, 1))).astype(np.int64)
    return [(np.flatnonzero(level == number), least * 2.0**number) for number in np.unique(level)]


def _cells(points: NDArray[np.float32], edge: float) -> tuple[IntArray, IntArray, IntArray]:
    """Return the sorted keys of cells, the points in that order, and the steps to neighbours before the keys."""
    places = np.floor((points - points.min(axis=0)) / edge).astype(np.int64) + 1
    size = places.max(axis=0) + 2
    strides = np.array([size[1] * size[2], size[2], 1], np.int64)
    own = places @ strides
    order = np.argsort(own, kind="stable")
    steps = np.array(list(product((-1, 0, 1), repeat=3)), np.int64) @ strides
    return own[order], order, np.concatenate([steps, own])
