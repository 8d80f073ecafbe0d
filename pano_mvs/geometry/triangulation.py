"""Triangulation of unit bearings."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry.transforms import Rigid3


def ranges_from_bearings(
    bearings_first: ArrayLike, bearings_second: ArrayLike, second_from_first: Rigid3
) -> tuple[FloatArray, FloatArray]:
    """Return the signed ranges, from either centre, of the points nearest to both rays (mid-point method).

    With C = −Rᵀt the second centre in the first frame and q = Rᵀ q₂: a = ((C × q)·(p × q)) / |p × q|² along
    p, and b = ((C × p)·(p × q)) / |p × q|² along q. Signed, well-conditioned, no acos.

    Args:
        bearings_first: (..., 3) unit rays p in the first camera.
        bearings_second: (..., 3) unit rays q₂ in the second camera.
        second_from_first: x_in_second = R x_in_first + t.

    Returns:
        Two arrays (...,): the range along the first and along the second ray, in units of t. A negative range
        means that the rays meet behind the camera; parallel rays give NaN.
    """
    p = np.asarray(bearings_first, dtype=np.float64)
    q = np.asarray(bearings_second, dtype=np.float64) @ second_from_first.rotation
    center = second_from_first.center
    normal = np.cross(p, q)
    squared = np.sum(normal**2, axis=-1)
    squared = np.where(squared > 1e-24, squared, np.nan)
    range_first = np.sum(np.cross(center, q) * normal, axis=-1) / squared
    range_second = np.sum(np.cross(center, p) * normal, axis=-1) / squared
    return range_first, range_second


def triangulate_bearings(bearings: ArrayLike, cams_from_world: list[Rigid3]) -> FloatArray:
    """Return the point with the least sum of squared distances to all rays of one or many tracks.

    Returns:
        (..., 3) points in the world. NaN where the rays are parallel.

    Raises:
        UsageError: if fewer than two cameras are given, or their number is not that of the bearings.
    """
    rays = np.asarray(bearings, dtype=np.float64)
    if len(cams_from_world) < 2 or len(rays) != len(cams_from_world):
        raise UsageError(
            f"triangulation needs one bearing for each of two or more cameras, got {len(rays)} bearings "
            f"and {len(cams_from_world)} cameras"
        )
    matrix = np.zeros((*rays.shape[1:-1], 3, 3))
    vector = np.zeros((*rays.shape[1:-1], 3))
    for ray, camera in zip(rays, cams_from_world, strict=True):
        ray_in_world = ray @ camera.rotation
        projector = np.eye(3) - ray_in_world[..., :, None] * ray_in_world[..., None, :]
        matrix += projector
        vector += projector @ camera.center
    degenerate = np.linalg.eigvalsh(matrix)[..., 0] < 1e-12
    matrix[degenerate] = np.eye(3)
    points = np.linalg.solve(matrix, vector[..., None])[..., 0]
    points[degenerate] = np.nan
    return np.asarray(points, dtype=np.float64)
