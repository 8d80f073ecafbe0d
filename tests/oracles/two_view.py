"""Two-view geometry written out in numpy: sides, costs, and refinement with derivatives of whole arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.essential import sampson_angles
from pano_mvs.algorithms.two_view.refinement import _linearised, tangent_basis
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, angle_between, rotation_from_rotvec, skew

BoolArray = NDArray[np.bool_]

_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def poses_from_essential(essential: FloatArray) -> list[Rigid3]:
    """The four second_from_first poses, |t| = 1, that share an essential matrix (3, 3)."""
    u, _, vt = np.linalg.svd(essential)
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    rotations = (u @ _QUARTER_TURN @ vt, u @ _QUARTER_TURN.T @ vt)
    return [Rigid3(rotation, sign * u[:, 2]) for rotation in rotations for sign in (1.0, -1.0)]


def in_front(first: FloatArray, second: FloatArray, second_from_first: Rigid3) -> BoolArray:
    """Whether each pair of rays, (M, 3) and (M, 3), meets at positive range from both centres, (M,).

    The signs of `ranges_from_bearings`' numerators, with C the second centre in the first frame and q de-rotated:
    (C × q)·(p × q) = C·p − (C·q)(p·q) and (C × p)·(p × q) = (C·p)(p·q) − C·q. Parallel rays do not meet.
    """
    q = second @ second_from_first.rotation
    center = second_from_first.center
    along_p, along_q, cosine = first @ center, q @ center, np.einsum("ni,ni->n", first, q)
    front: BoolArray = (along_p > along_q * cosine) & (along_p * cosine > along_q)
    return front


def facing_pose(essential: FloatArray, first: FloatArray, second: FloatArray, threshold_rad: float) -> Rigid3:
    """The decomposition of an essential matrix with most inliers in front of both cameras."""
    inliers = sampson_angles(essential, first, second) < threshold_rad
    poses = poses_from_essential(essential)
    return max(poses, key=lambda pose: int(in_front(first[inliers], second[inliers], pose).sum()))


def plausible(first: FloatArray, second: FloatArray, pose: Rigid3, threshold_rad: float) -> BoolArray:
    """Which matches lie in front of both cameras, or so far away that noise decides their sign, (M,)."""
    far: BoolArray = angle_between(first @ pose.rotation.T, second) < 2 * threshold_rad
    return far | in_front(first, second, pose)


def agreement(
    pose: Rigid3, first: FloatArray, second: FloatArray, threshold_rad: float
) -> tuple[FloatArray, BoolArray]:
    """The Sampson errors and which matches agree."""
    residuals = sampson_angles(skew(pose.translation) @ pose.rotation, first, second)
    return residuals, (residuals < threshold_rad) & plausible(first, second, pose, threshold_rad)


def facing_costs(poses: Sequence[Rigid3], first: FloatArray, second: FloatArray, threshold_rad: float) -> FloatArray:
    """Σ min(r² / threshold², 1) for each pose, where a match behind a camera costs 1."""
    found = []
    for pose in poses:
        residuals, agreeing = agreement(pose, first, second, threshold_rad)
        found.append(np.where(agreeing, (residuals / threshold_rad) ** 2, 1.0).sum())
    return np.array(found)


def msac_costs(essentials: FloatArray, first: FloatArray, second: FloatArray, threshold_rad: float) -> FloatArray:
    """Σ min(r² / threshold², 1) over all matches, for each of the essential matrices (N, 3, 3)."""
    residuals = sampson_angles(essentials, first, second)
    costs: FloatArray = np.sum(np.minimum((residuals / threshold_rad) ** 2, 1.0), axis=-1)
    return costs


def refine_relative_pose(
    pose: Rigid3, first: FloatArray, second: FloatArray, *, scale_rad: float, max_iterations: int = 20
) -> Rigid3:
    """The pose with the least Cauchy loss of the Sampson error, by Gauss–Newton with step halving."""
    residuals, jacobian = _linearised(pose, first, second)
    cost = cauchy_loss(residuals, scale_rad)
    for _ in range(max_iterations):
        weights = 1 / (1 + (residuals / scale_rad) ** 2)
        hessian = (jacobian * weights[:, None]).T @ jacobian
        hessian += 1e-9 * np.trace(hessian) * np.eye(5)
        step = -np.linalg.solve(hessian, jacobian.T @ (weights * residuals)).astype(np.float64)
        for shrink in (1.0, 0.3, 0.1, 0.01):
            moved = moved_pose(pose, shrink * step)
            moved_residuals, moved_jacobian = _linearised(moved, first, second)
            moved_cost = cauchy_loss(moved_residuals, scale_rad)
            if moved_cost < cost:
                break
        else:
            break
        gain = cost - moved_cost
        pose, residuals, jacobian, cost = moved, moved_residuals, moved_jacobian, moved_cost
        if gain < 1e-10 * cost:
            break
    return pose


def moved_pose(pose: Rigid3, step: FloatArray) -> Rigid3:
    """The pose after a step along ω and along t's two tangents, (5,)."""
    translation = pose.translation + tangent_basis(pose.translation) @ step[3:]
    return Rigid3(rotation_from_rotvec(step[:3]) @ pose.rotation, translation / np.linalg.norm(translation))


def cauchy_loss(residuals: FloatArray, scale_rad: float) -> float:
    """Σ log(1 + r² / scale²)."""
    return float(np.sum(np.log1p((residuals / scale_rad) ** 2)))
