"""Inliers of a relative pose: small residuals, and in front of both cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3


def facing_pose(essential: FloatArray, first: FloatArray, second: FloatArray, *, threshold_rad: float) -> Rigid3:
    """Return the decomposition of an essential matrix with most inliers in front of both cameras.

    Args:
        essential: (3, 3), of any scale.
        first: (M, 3) unit bearings.
        second: (M, 3) unit bearings.
        threshold_rad: maximum Sampson error of an inlier.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import decompose_facing

    rotation, translation = np.empty((3, 3)), np.empty(3)
    scaled = np.ascontiguousarray(essential * (np.sqrt(2) / np.linalg.norm(essential)))
    decompose_facing(scaled, _rows(first), _rows(second), threshold_rad, rotation, translation)
    return Rigid3(rotation, translation)


def agreement(
    pose: Rigid3, first: FloatArray, second: FloatArray, *, threshold_rad: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the Sampson errors, (M,), and which matches agree with a pose, |t| = 1.

    A match agrees if its error is small and it lies in front of both cameras, or is so far away (the angle between its
    rays is below twice the threshold) that noise determines the side.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import pose_residuals

    residuals, agreeing = np.empty(len(first)), np.empty(len(first), np.bool_)
    pose_residuals(*_parts(pose), _rows(first), _rows(second), threshold_rad, residuals, agreeing)
    return residuals, agreeing


def facing_costs(poses: Sequence[Rigid3], first: FloatArray, second: FloatArray, *, threshold_rad: float) -> FloatArray:
    """Return Σ min(r² / threshold², 1) for each pose, where a match behind a camera costs 1.

    Matches on one plane fit two essential matrices exactly; only cheirality distinguishes these.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import pose_cost

    p, q = _rows(first), _rows(second)
    return np.array([pose_cost(*_parts(pose), p, q, threshold_rad) for pose in poses])


def least_essentials(
    essentials: FloatArray,
    first: FloatArray,
    second: FloatArray,
    *,
    threshold_rad: float,
    limit: float = np.inf,
    sigmas: float = 3.0,
    count: int,
) -> FloatArray:
    """Return the essential matrices with the lowest Σ min(r² / threshold², 1), ignoring cheirality.

    A matrix that is far worse than the best after a few matches is rejected early (after Capel 2005, "An effective
    bail-out test for RANSAC consensus scoring"); about one in a thousand of the best ones is lost.

    Args:
        essentials: (N, 3, 3).
        first: (M, 3) unit bearings in random order.
        second: (M, 3) unit bearings.
        threshold_rad: Sampson error from which a match costs 1.
        limit: return only matrices with a lower cost.
        sigmas: how much worse a matrix may be, in standard deviations; infinity rejects none that would have been the
            best.
        count: maximum number of matrices.

    Returns:
        (K, 3, 3), K ≤ count, best first.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import rank_essentials

    best, costs = np.empty(count, np.int64), np.empty(count)
    rank_essentials(_rows(essentials), _rows(first), _rows(second), threshold_rad, limit, sigmas, best, costs)
    return essentials[best[best >= 0]]


def _parts(pose: Rigid3) -> tuple[FloatArray, FloatArray]:
    return _rows(pose.rotation), _rows(pose.translation)


def _rows(array: FloatArray) -> FloatArray:
    """Return an array in the form that the kernels expect: float64 in C order."""
    return np.ascontiguousarray(array, np.float64)
