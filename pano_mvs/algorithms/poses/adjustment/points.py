"""Triangulate many tracks at once, and drop observations that do not fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray, IndexArray

ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Triangulated points of tracks, and the observations that support them."""

    points_in_world: FloatArray  # (P, 3), NaN if a track gives no point
    valid: NDArray[np.bool_]  # (P,) bool
    used: NDArray[np.bool_]  # (T,) bool, the observations that fit a valid point
    errors_rad: FloatArray  # (T,) angle between the observed ray and the ray to the point; π if there is no point


def triangulate_observations(
    centers: FloatArray,
    rays_in_world: FloatArray,
    point_idx: IndexArray,
    *,
    count: int,
    max_error_rad: float,
    min_angle_rad: float,
) -> Triangulated:
    """Triangulate tracks; the worst observation of a track is removed until all remaining ones fit.

    Args:
        centers: (T, 3) camera centre of every observation, in the world.
        rays_in_world: (T, 3) its unit ray, rotated into the world.
        point_idx: (T,) the track of every observation, ascending.
        count: P, number of tracks.
        max_error_rad: largest angle between an observed ray and the ray to the point.
        min_angle_rad: smallest angle between the rays of a track of two; longer tracks must be as well conditioned.
    """
    # Importing numba takes most of a second, so import it only where it is used.
    from pano_mvs.algorithms.poses.adjustment.kernels_points import triangulate

    starts = np.searchsorted(point_idx, np.arange(count + 1))
    # For two rays at angle α the smallest eigenvalue of Σ (I − r rᵀ) is 1 − cos α; more rays only increase it.
    least = float(1 - np.cos(min_angle_rad))
    return Triangulated(
        *triangulate(
            np.ascontiguousarray(centers), np.ascontiguousarray(rays_in_world), starts, least, max_error_rad, ROUNDS
        )
    )
