"""Which side of the cameras matches lie on, and what that says of a hypothesis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.essential import in_front, poses_from_essential, sampson_angles
from pano_mvs.geometry import Rigid3, angle_between, skew

FloatArray = NDArray[np.float64]


def facing_pose(essential: FloatArray, first: FloatArray, second: FloatArray, threshold_rad: float) -> Rigid3:
    """Return the decomposition of an essential matrix with most inliers in front of both cameras.

    Args:
        essential: (3, 3).
        first: (M, 3) unit bearings.
        second: (M, 3) unit bearings.
        threshold_rad: Sampson error below which a match is an inlier.
    """
    inliers = sampson_angles(essential, first, second) < threshold_rad
    poses = poses_from_essential(essential)
    return max(poses, key=lambda pose: int(in_front(first[inliers], second[inliers], pose).sum()))


def plausible(first: FloatArray, second: FloatArray, pose: Rigid3, threshold_rad: float) -> NDArray[np.bool_]:
    """Return which matches lie in front of both cameras, or so far away that noise decides their sign, (M,)."""
    far = angle_between(first @ pose.rotation.T, second) < 2 * threshold_rad
    accepted: NDArray[np.bool_] = far | in_front(first, second, pose)
    return accepted


def agreement(
    pose: Rigid3, first: FloatArray, second: FloatArray, threshold_rad: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the Sampson errors, (M,), and which matches agree: a small error, and in front of both cameras."""
    residuals = sampson_angles(skew(pose.translation) @ pose.rotation, first, second)
    agreeing: NDArray[np.bool_] = (residuals < threshold_rad) & plausible(first, second, pose, threshold_rad)
    return residuals, agreeing


def facing_costs(
    poses: Sequence[Rigid3], first: FloatArray, second: FloatArray, threshold_rad: float
) -> NDArray[np.float64]:
    """Return Σ min(r² / threshold², 1) for each pose, where a match behind a camera costs 1.

    The matches of one plane fit two essential matrices exactly; what lies behind the cameras tells them apart.
    """
    essentials = np.array([skew(pose.translation) @ pose.rotation for pose in poses])
    costs = np.minimum((sampson_angles(essentials, first, second) / threshold_rad) ** 2, 1.0)
    for cost, pose in zip(costs, poses, strict=True):
        near = np.flatnonzero(cost < 1)
        cost[near[~plausible(first[near], second[near], pose, threshold_rad)]] = 1.0
    total: FloatArray = costs.sum(axis=1)
    return total
