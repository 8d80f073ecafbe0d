"""Find the camera or the point of the cloud under the pointer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray

# A ray hits a point within this angle: half the width of a click at a usual field of view.
_REACH_RAD = np.deg2rad(0.4)


def camera_under(start: FloatArray, direction: FloatArray, centers: FloatArray, *, radius: float) -> int | None:
    """Return the nearest camera whose sphere a ray intersects, or None.

    Args:
        start: (3,) origin of the ray.
        direction: (3,) unit.
        centers: (N, 3) of the spheres.
        radius: of each of them.
    """
    along, aside = _along_and_aside(start, direction, centers)
    met = (aside <= radius) & (along > radius)
    if not met.any():
        return None
    candidates = np.flatnonzero(met)
    return int(candidates[np.argmin(along[candidates])])


def point_under(
    start: FloatArray,
    direction: FloatArray,
    points: NDArray[np.float32],
    *,
    normals: NDArray[np.float32] | None = None,
    parallel_reach: float = 0.0,
) -> int | None:
    """Return the nearest point close to a ray, or None.

    Args:
        start: (3,) origin of the ray.
        direction: (3,) unit.
        points: (N, 3).
        normals: (N, 3); points that face away are ignored, since they are not drawn. None: use all points.
        parallel_reach: maximum distance from the ray, scene units; 0: it grows with the distance from the viewer.
    """
    if not len(points):
        return None
    along, aside = _along_and_aside(start, direction, points)
    near = (along > 0) & (aside < (parallel_reach or np.tan(_REACH_RAD) * along))
    candidates = np.flatnonzero(near)
    if normals is not None:
        seen_along = direction if parallel_reach else points[candidates] - start
        candidates = candidates[np.sum(normals[candidates] * seen_along, axis=-1) <= 0]
    if not len(candidates):
        return None
    first = float(along[candidates].min())
    # Of the foremost surface, the point closest to the ray.
    foremost = candidates[along[candidates] <= first * (1 + 4 * np.tan(_REACH_RAD))]
    return int(foremost[np.argmin(aside[foremost])])


def _along_and_aside(
    start: FloatArray, direction: FloatArray, points: NDArray[np.floating]
) -> tuple[FloatArray, FloatArray]:
    """Return the distance of each point along a ray and from it, (N,) each."""
    offsets = np.asarray(points, np.float64) - start
    along = offsets @ direction
    aside = np.sqrt(np.maximum(np.einsum("ni,ni->n", offsets, offsets) - along**2, 0))
    return along, aside
