"""Slow, obvious versions of what pose solvers compute."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle
from pano_mvs.algorithms.poses.adjustment.tracks import Triangulated
from pano_mvs.core.arrays import FloatArray, IndexArray
from pano_mvs.geometry import pixel_from_ray, rotation_from_rotvec


def cubic_value(picture: FloatArray, column: float, row: float) -> float:
    """Return a picture between its pixels by cubic convolution, a = −1/2; (0, 0) is the first pixel's centre."""

    def kernel(distance: NDArray[Any]) -> FloatArray:
        d = np.abs(distance)
        near = 1.5 * d**3 - 2.5 * d**2 + 1
        far = -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2
        return np.where(d < 1, near, np.where(d < 2, far, 0.0))

    columns, rows = int(np.floor(column)) + np.arange(-1, 3), int(np.floor(row)) + np.arange(-1, 3)
    return float(kernel(rows - row) @ picture[np.ix_(rows, columns)] @ kernel(columns - column))


def sampled_patch(
    padded: FloatArray, pad_px: int, middle: FloatArray, axes: tuple[FloatArray, FloatArray], size: int
) -> FloatArray:
    """Return the patch (n, n) of a panorama with a margin along rays middle + u axes[0] + v axes[1]."""
    steps = np.arange(size) - (size - 1) / 2
    rays = middle + steps[None, :, None] * axes[0] + steps[:, None, None] * axes[1]
    size_hw = (padded.shape[0] - 2 * pad_px, padded.shape[1] - 2 * pad_px)
    pixels = pixel_from_ray(rays / np.linalg.norm(rays, axis=-1, keepdims=True), size_hw) - 0.5 + pad_px
    return np.array([[cubic_value(padded, *pixel) for pixel in line] for line in pixels])


def aligned_shift(
    reference: FloatArray, target: FloatArray, window: FloatArray, stiffness: float
) -> tuple[FloatArray, float, float]:
    """Return shift (2,), correlation and deviation of one patch, as `aligned_shifts`, by matrices."""
    size = len(window)
    margin = (len(reference) - size) // 2
    inner = slice(margin, margin + size)
    w = window.ravel() / window.sum()
    v, u = (axis.ravel() for axis in np.mgrid[:size, :size] - (size - 1) / 2)

    def normalised(values: FloatArray) -> FloatArray:
        centred = values - w @ values
        result: FloatArray = centred / np.sqrt(w @ centred**2)
        return result

    def warped(warp: FloatArray) -> FloatArray:
        places = warp @ np.stack([u, v, np.ones_like(u)]) + (size - 1) / 2 + margin
        return normalised(np.array([cubic_value(target, *place) for place in places.T]))

    raw = reference[inner, inner].ravel()
    template, contrast = normalised(raw), np.sqrt(w @ (raw - w @ raw) ** 2)
    down, across = (np.gradient(reference, axis=axis)[inner, inner].ravel() / contrast for axis in (0, 1))
    jacobian = np.stack([across, down, across * u, across * v, down * u, down * v], axis=1)
    jacobian -= w @ jacobian + np.outer(template, template * w @ jacobian)
    prior = stiffness * np.diag([0.0, 0, 1, 1, 1, 1])
    matrix = window.sum() * jacobian.T @ (w[:, None] * jacobian) + prior
    warp = np.array([[1.0, 0, 0], [0, 1, 0]])
    for _ in range(12):
        bent = np.array([0, 0, warp[0, 0] - 1, warp[0, 1], warp[1, 0], warp[1, 1] - 1])
        e = np.linalg.solve(matrix, window.sum() * jacobian.T @ (w * (warped(warp) - template)) + prior @ bent)
        step = np.array([[1 + e[2], e[3], e[0]], [e[4], 1 + e[5], e[1]], [0, 0, 1]])
        warp = (np.vstack([warp, [0, 0, 1]]) @ np.linalg.inv(step))[:2]
        if np.abs(e[:2]).max() < 0.003:
            break
    deviation = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(matrix)[:2, :2])[-1]))
    return warp[:, 2], float(w @ (warped(warp) * template)), deviation


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


_UPPER = np.triu_indices(3)


def triangulate_numpy(
    centers: FloatArray,
    rays_in_world: FloatArray,
    point_idx: IndexArray,
    *,
    count: int,
    max_error_rad: float,
    min_angle_rad: float,
) -> Triangulated:
    """Return the points of tracks; the worst observation of a track goes until all that remain fit."""
    used = np.ones(len(point_idx), np.bool_)
    for _ in range(8):
        points, valid = _solve(centers, rays_in_world, point_idx, used, count=count, min_angle_rad=min_angle_rad)
        errors = _errors(centers, rays_in_world, points[point_idx], valid[point_idx])
        bad = used & valid[point_idx] & (errors > max_error_rad)
        if not bad.any():
            break
        worst = np.zeros(count)
        np.maximum.at(worst, point_idx[bad], errors[bad])
        used &= ~(bad & (errors >= worst[point_idx]))
    spoilt = np.zeros(count, np.bool_)
    spoilt[point_idx[used & (errors > max_error_rad)]] = True
    valid &= ~spoilt
    used &= valid[point_idx]
    points[~valid] = np.nan
    return Triangulated(points, valid, used, errors)


def _solve(
    centers: FloatArray,
    rays: FloatArray,
    point_idx: IndexArray,
    used: NDArray[np.bool_],
    *,
    count: int,
    min_angle_rad: float,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return points and validity: nearest to all rays, then twice reweighted by range so that angles count."""
    idx, c, r = point_idx[used], centers[used], rays[used]
    enough = np.bincount(idx, minlength=count) >= 2
    weights = np.ones(len(idx))
    points = np.full((count, 3), np.nan)
    for step in range(3):
        matrix, vector = _normal_equations(c, r, idx, weights, count)
        if step == 0:
            # For two rays at angle α the least eigenvalue is 1 − cos α; more rays only add to it.
            enough &= np.linalg.eigvalsh(matrix)[:, 0] > 1 - np.cos(min_angle_rad)
        matrix[~enough] = np.eye(3)
        points = np.linalg.solve(matrix, vector[..., None])[..., 0]
        squared_range = np.sum((points[idx] - c) ** 2, axis=1)
        mean = np.bincount(idx, squared_range, count) / np.maximum(np.bincount(idx, minlength=count), 1)
        # Rays that cross in the very place of their cameras (one place for all) say nothing of a point.
        enough &= ~(mean <= 0)
        weights = mean[idx] / np.maximum(squared_range, 1e-6 * mean[idx] + 1e-300)
    return points, enough


def _normal_equations(
    centers: FloatArray, rays: FloatArray, idx: IndexArray, weights: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return Σ w (I − r rᵀ), (count, 3, 3), and Σ w (I − r rᵀ) c, (count, 3)."""
    matrix = np.empty((count, 3, 3))
    for row, column in zip(*_UPPER, strict=True):
        entry = weights * (float(row == column) - rays[:, row] * rays[:, column])
        matrix[:, row, column] = matrix[:, column, row] = np.bincount(idx, entry, count)
    across = weights[:, None] * (centers - np.sum(rays * centers, axis=1)[:, None] * rays)
    return matrix, np.stack([np.bincount(idx, across[:, axis], count) for axis in range(3)], axis=1)


def _errors(centers: FloatArray, rays: FloatArray, points: FloatArray, valid: NDArray[np.bool_]) -> FloatArray:
    """Return the angle between observed rays and points, π where there is no point (a ray behind gives > π/2)."""
    errors = np.full(len(rays), np.pi)
    towards = points[valid] - centers[valid]
    sine = np.linalg.norm(np.cross(rays[valid], towards), axis=1)
    errors[valid] = np.arctan2(sine, np.sum(rays[valid] * towards, axis=1))
    return errors
