"""The reduced camera system from the whole Jacobian, written out and derived numerically."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import rotation_from_rotvec


def tangent_residuals(bundle: Bundle, bases: FloatArray, steps: FloatArray) -> FloatArray:
    """Residuals Bᵀ x / |x| after steps (ω, C) of all cameras, then of all points; (2 T,)."""
    cameras = len(bundle.centers)
    camera_steps = steps[: 6 * cameras].reshape(cameras, 6)
    points = bundle.points + steps[6 * cameras :].reshape(-1, 3)
    residuals = []
    for point, image, basis, origin in zip(bundle.point_idx, bundle.image_idx, bases, bundle.origins, strict=True):
        rotation = rotation_from_rotvec(camera_steps[image, :3]) @ bundle.rotations[image]
        x = rotation @ (points[point] - bundle.centers[image] - camera_steps[image, 3:]) - origin
        residuals.append(basis.T @ x / np.linalg.norm(x))
    return np.concatenate(residuals)


def reduced_system_dense(
    bundle: Bundle, bases: FloatArray, weights: FloatArray, damping: float
) -> tuple[FloatArray, FloatArray]:
    """Schur complement (6N, 6N) and right-hand side (6N,), points damped, cameras not."""
    size = 6 * len(bundle.centers) + 3 * len(bundle.points)
    h = 1e-6
    steps = h * np.eye(size)
    columns = [(tangent_residuals(bundle, bases, s) - tangent_residuals(bundle, bases, -s)) / (2 * h) for s in steps]
    root = np.sqrt(np.repeat(weights, 2))
    jacobian = root[:, None] * np.stack(columns, axis=1)
    residuals = root * tangent_residuals(bundle, bases, np.zeros(size))
    hessian, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
    split = 6 * len(bundle.centers)
    inner = hessian[split:, split:] + damping * np.diag(np.diag(hessian)[split:])
    coupling = hessian[:split, split:] @ np.linalg.inv(inner)
    return hessian[:split, :split] - coupling @ hessian[split:, :split], gradient[:split] - coupling @ gradient[split:]
