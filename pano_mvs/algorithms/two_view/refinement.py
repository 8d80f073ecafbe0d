"""Non-linear refinement of two-view geometries: minimise the angular error over the five degrees of freedom."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pano_mvs.algorithms.two_view.cheirality import agreement
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, skew


def refine_relative_pose(
    pose: Rigid3, first: FloatArray, second: FloatArray, *, scale_rad: float, max_iterations: int = 20
) -> Rigid3:
    """Minimise the Cauchy loss of the spherical Sampson error over second_from_first, |t| = 1.

    Gauss–Newton with reweighting and step halving; R ← exp(ω) R, t moves on the unit sphere.

    Args:
        pose: initial pose, |t| = 1.
        first: (M, 3) unit bearings in the first image.
        second: (M, 3) unit bearings in the second.
        scale_rad: residual at which the weight is one half.
        max_iterations: maximum number of steps.
    """
    from pano_mvs.algorithms.two_view.kernels_refinement import refine_pose

    rotation, translation = pose.rotation.astype(np.float64), pose.translation.astype(np.float64)
    p, q = np.ascontiguousarray(first, np.float64), np.ascontiguousarray(second, np.float64)
    refine_pose(rotation, translation, p, q, scale_rad, max_iterations)
    return Rigid3(rotation, translation)


def refined_on_agreeing(
    pose: Rigid3,
    first: FloatArray,
    second: FloatArray,
    *,
    thresholds_rad: Sequence[float],
    least: int = 8,
    max_iterations: int = 20,
) -> tuple[Rigid3, bool]:
    """Refine a pose on the matches that agree with it within successive thresholds, until one has too few.

    Args:
        pose: initial pose, |t| = 1.
        first: (M, 3) unit bearings in the first image.
        second: (M, 3) unit bearings in the second.
        thresholds_rad: maximum Sampson errors.
        least: minimum number of matches.
        max_iterations: maximum number of steps for each threshold.

    Returns:
        The pose, and whether each threshold had enough matches.
    """
    for threshold_rad in thresholds_rad:
        near = agreement(pose, first, second, threshold_rad=threshold_rad)[1]
        if near.sum() < least:
            return pose, False
        pose = refine_relative_pose(
            pose, first[near], second[near], scale_rad=0.5 * threshold_rad, max_iterations=max_iterations
        )
    return pose, True


def pose_uncertainty(pose: Rigid3, first: FloatArray, second: FloatArray, *, noise_rad: float) -> tuple[float, float]:
    """Return the standard deviations, in radians, of rotation and direction along their least certain axes.

    The square roots of the largest eigenvalues of the blocks of σ² (JᵀJ)⁻¹.

    Args:
        pose: second_from_first, |t| = 1, at the optimum.
        first: (M, 3) unit bearings of inliers.
        second: (M, 3) unit bearings.
        noise_rad: σ, standard deviation of the residuals.
    """
    jacobian = _linearised(pose, first, second)[1]
    hessian = jacobian.T @ jacobian
    covariance = noise_rad**2 * np.linalg.inv(hessian + 1e-12 * np.trace(hessian) * np.eye(5))
    rotation, direction = np.linalg.eigvalsh(covariance[:3, :3])[-1], np.linalg.eigvalsh(covariance[3:, 3:])[-1]
    return float(np.sqrt(max(rotation, 0.0))), float(np.sqrt(max(direction, 0.0)))


def tangent_basis(directions: FloatArray) -> FloatArray:
    """Return two unit vectors normal to each direction and to each other; (..., 3) to (..., 3, 2)."""
    axis = np.eye(3)[np.argmin(np.abs(directions), axis=-1)]
    u = cross(directions, axis)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    basis: FloatArray = np.stack([u, cross(directions, u)], axis=-1)
    return basis


def _linearised(pose: Rigid3, first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the signed residuals r = e / √D, (M,), and their derivatives by ω and by t's two tangents, (M, 5).

    With a = R p, e = q·(t × a) and D = |t × a|² + |t × q|² − 2 e²:
    ∂e/∂ω = (t·a) q − (q·a) t, ∂e/∂t = a × q, ∂|t × a|²/∂ω = 2 (t·a) (t × a), ∂|t × a|²/∂t = −2 (t·a) a.
    """
    t, q, a = pose.translation, second, first @ pose.rotation.T
    t_cross_a = a @ skew(t).T
    t_dot_a, t_dot_q = a @ t, q @ t
    e = np.sum(q * t_cross_a, axis=1)
    squared = np.maximum(2 - t_dot_a**2 - t_dot_q**2 - 2 * e**2, 1e-12)
    e_by_omega = t_dot_a[:, None] * q - np.sum(q * a, axis=1)[:, None] * t
    e_by_t = cross(a, q)
    d_by_omega = 2 * t_dot_a[:, None] * t_cross_a - 4 * e[:, None] * e_by_omega
    d_by_t = -2 * (t_dot_a[:, None] * a + t_dot_q[:, None] * q) - 4 * e[:, None] * e_by_t
    root = np.sqrt(squared)[:, None]
    tangents = tangent_basis(t)
    e_by = np.concatenate([e_by_omega, e_by_t @ tangents], axis=1)
    d_by = np.concatenate([d_by_omega, d_by_t @ tangents], axis=1)
    return e / root[:, 0], e_by / root - 0.5 * e[:, None] * d_by / root**3


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b, (..., 3), without the overhead of numpy's general case, which exceeds that of the product."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)
