"""Triangulation of tracks with numpy, all tracks at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.points import ROUNDS, Triangulated
from pano_mvs.core.arrays import FloatArray, IndexArray

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
    for _ in range(ROUNDS):
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
