"""Compiled: planes through the points around each pixel of a range map.

A plane p holds the points X with p · X = 1, so that a ray d meets it where 1 / range = p · d: planes are linear in the
inverse range q. Around a pixel q = α + β u + γ v, with u in columns (widened away from the equator) and v in rows.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pano_mvs.geometry.kernels_sphere import azimuth_from_x, elevation_from_y, wrapped_column, wrapped_row

FloatArray = NDArray[np.float64]

_F = np.float32
# Minimum weight of the pixels of a plane, and minimum determinant of their covariance in u and v.
_MIN_WEIGHT, _MIN_SPREAD = 5.0, 0.25


@njit(cache=True, error_model="numpy", nogil=True)
def tangent_basis(row: int, column: int, height: int, width: int, stretch: float, basis: FloatArray) -> None:
    """Write the ray of a pixel and its derivatives by u and v, (3, 3); the rows are orthogonal."""
    elevation, azimuth = elevation_from_y(row + 0.5, height), azimuth_from_x(column + 0.5, width)
    level, dip, s, c = np.cos(elevation), np.sin(elevation), np.sin(azimuth), np.cos(azimuth)
    across, down = 2 * np.pi / width * level * stretch, np.pi / height
    basis[0, 0], basis[0, 1], basis[0, 2] = level * s, -dip, level * c
    basis[1, 0], basis[1, 1], basis[1, 2] = across * c, 0.0, -across * s
    basis[2, 0], basis[2, 1], basis[2, 2] = down * dip * s, down * level, down * dip * c


@njit(cache=True, error_model="numpy", nogil=True)
def plane_from_slopes(alpha: float, beta: float, gamma: float, basis: FloatArray, plane: FloatArray) -> None:
    """Write the plane p, (3,), on which q = α + β u + γ v to first order."""
    across = basis[1, 0] ** 2 + basis[1, 2] ** 2
    down = basis[2, 0] ** 2 + basis[2, 1] ** 2 + basis[2, 2] ** 2
    for a in range(3):
        plane[a] = alpha * basis[0, a] + beta / across * basis[1, a] + gamma / down * basis[2, a]


@njit(cache=True, error_model="numpy", nogil=True)
def weighted_slopes(
    values: FloatArray,
    offsets: NDArray[np.int64],
    stretch: float,
    guess: tuple[float, float, float],
    tolerance: float,
    growth: float,
) -> tuple[float, float, float, bool]:
    """Return (α, β, γ, well posed) of the plane through the values (side, side) of a window.

    Weights are Tukey's biweight of the distance from the plane `guess` (α, β, γ), which is 0 from `tolerance` plus
    `growth` per step from the centre.
    """
    side = len(offsets)
    radius = side // 2
    n, su, sv, suu, suv, svv, sq, squ, sqv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(side):
        v = row - radius
        for step in range(side):
            u, value = offsets[step] / stretch, values[row, step]
            reach = tolerance + growth * max(abs(step - radius), abs(v))
            deviation = (value - guess[0] - guess[1] * u - guess[2] * v) / reach
            if not deviation * deviation < 1:  # NaN included
                continue
            w = (1 - deviation * deviation) ** 2
            n += w
            su += w * u
            sv += w * v
            suu += w * u * u
            suv += w * u * v
            svv += w * v * v
            sq += w * value
            squ += w * value * u
            sqv += w * value * v
    n = max(n, 1e-30)
    mu, mv, mq = su / n, sv / n, sq / n
    suu, suv, svv = suu / n - mu * mu, suv / n - mu * mv, svv / n - mv * mv
    squ, sqv = squ / n - mq * mu, sqv / n - mq * mv
    determinant = suu * svv - suv * suv
    if n < _MIN_WEIGHT or determinant < _MIN_SPREAD:
        return guess[0], guess[1], guess[2], False
    beta, gamma = (svv * squ - suv * sqv) / determinant, (suu * sqv - suv * squ) / determinant
    return mq - beta * mu - gamma * mv, beta, gamma, True


@njit(cache=True, error_model="numpy", nogil=True)
def fit_slopes(
    inverse: NDArray[np.float32],
    row: int,
    column: int,
    offsets: NDArray[np.int64],
    stretch: float,
    max_step: float,
    values: FloatArray,
) -> tuple[float, float, float]:
    """Return (α, β, γ) of the plane through the inverse ranges around a pixel, robustly, in units of its own q.

    First fit the neighbours that differ from the pixel by less than `max_step` per step plus one, then those within
    `max_step` of that plane. With too few neighbours q stays as it is, and the surface faces the camera.
    `values`, (side, side) float64, is scratch space.
    """
    height, width = inverse.shape
    side = len(offsets)
    center = np.float64(inverse[row, column])
    for j in range(side):
        y = row + j - side // 2
        in_row = wrapped_row(y, height)
        for step in range(side):
            values[j, step] = inverse[in_row, wrapped_column(y, column + offsets[step], height, width)] / center
    alpha, beta, gamma, _ = weighted_slopes(values, offsets, stretch, (1.0, 0.0, 0.0), max_step, max_step)
    alpha, beta, gamma, _ = weighted_slopes(values, offsets, stretch, (alpha, beta, gamma), max_step, 0.0)
    return alpha, beta, gamma


@njit(cache=True, error_model="numpy", nogil=True)
def fit_planes(
    inverse: NDArray[np.float32],
    first: int,
    rows: int,
    offsets: NDArray[np.int64],
    stretches: FloatArray,
    max_step: float,
    planes: NDArray[np.float32],
) -> None:
    """Write the planes of some rows, (3, H, W) float32; 0, the plane at infinity, where the range is unknown.

    Args:
        inverse: (H, W) float32 1 / range, NaN where unknown.
        first: the first row.
        rows: number of rows.
        offsets: (H, side) int64 columns of the window.
        stretches: (H,) float64 columns per step in u.
        max_step: see `fit_slopes`.
        planes: (3, H, W) float32, written.
    """
    height, width = inverse.shape
    basis, plane = np.empty((3, 3)), np.empty(3)
    values = np.empty((offsets.shape[1], offsets.shape[1]))
    for row in range(first, first + rows):
        for column in range(width):
            q = np.float64(inverse[row, column])
            plane[:] = 0.0
            if np.isfinite(q):
                alpha, beta, gamma = fit_slopes(inverse, row, column, offsets[row], stretches[row], max_step, values)
                tangent_basis(row, column, height, width, stretches[row], basis)
                plane_from_slopes(q * alpha, q * beta, q * gamma, basis, plane)
            for a in range(3):
                planes[a, row, column] = _F(plane[a])
