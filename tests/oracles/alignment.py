"""Patches of a panorama and their alignment, one patch and one array expression at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pixel_from_ray


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
