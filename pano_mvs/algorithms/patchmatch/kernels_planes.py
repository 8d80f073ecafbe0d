"""Compiled: planes through the points around each pixel of a range map.

A plane p holds the points X with p · X = 1, so that a ray d meets it where 1 / range = p · d: what follows is linear in
the inverse range q. Around a pixel q = α + β u + γ v, with u and v in columns (widened away from the equator) and rows.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_F = np.float32
# So many pixels at least, and so much spread of theirs in u and v, make a plane.
_FEWEST, _LEAST_SPREAD = 5.0, 0.25


@njit(cache=True, error_model="numpy", nogil=True)
def tangent_basis(row, column, height, width, stretch, basis):  # type: ignore[no-untyped-def]
    """Write the ray of a pixel and what one step in u and one in v add to it, (3, 3), orthogonal."""
    elevation = np.pi * (0.5 - (row + 0.5) / height)
    azimuth = 2 * np.pi * ((column + 0.5) / width - 0.5)
    level, dip, s, c = np.cos(elevation), np.sin(elevation), np.sin(azimuth), np.cos(azimuth)
    across, down = 2 * np.pi / width * level * stretch, np.pi / height
    basis[0, 0], basis[0, 1], basis[0, 2] = level * s, -dip, level * c
    basis[1, 0], basis[1, 1], basis[1, 2] = across * c, 0.0, -across * s
    basis[2, 0], basis[2, 1], basis[2, 2] = down * dip * s, down * level, down * dip * c


@njit(cache=True, error_model="numpy", nogil=True)
def plane_from_slopes(alpha, beta, gamma, basis, plane):  # type: ignore[no-untyped-def]
    """Write the plane p, (3,), on which q = α + β u + γ v to first order."""
    across = basis[1, 0] ** 2 + basis[1, 2] ** 2
    down = basis[2, 0] ** 2 + basis[2, 1] ** 2 + basis[2, 2] ** 2
    for a in range(3):
        plane[a] = alpha * basis[0, a] + beta / across * basis[1, a] + gamma / down * basis[2, a]


@njit(cache=True, error_model="numpy", nogil=True)
def fit_slopes(inverse, row, column, offsets, stretch, max_step):  # type: ignore[no-untyped-def]
    """Return (α, β, γ) of the plane through the inverse ranges around a pixel, robustly, in units of its own q.

    The weight of a neighbour falls to nothing where its q differs by the share `max_step` for each step and one more
    (Tukey's biweight). Too few neighbours leave q as it is, and the surface facing the camera.
    """
    height, width = inverse.shape
    radius = offsets.shape[0] // 2
    center = np.float64(inverse[row, column])
    n, su, sv, suu, suv, svv, sq, squ, sqv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for v in range(-radius, radius + 1):
        y, turn = row + v, 0
        if y < 0 or y >= height:  # beyond a pole: half a turn further on
            y = -1 - y if y < 0 else 2 * height - 1 - y
            turn = width // 2
        for step in range(offsets.shape[0]):
            value = inverse[y, (column + offsets[step] + turn) % width] / center - 1.0
            deviation = abs(value) / (max_step * (1 + max(abs(step - radius), abs(v))))
            if not deviation < 1:  # NaN included
                continue
            w = (1 - deviation * deviation) ** 2
            u = offsets[step] / stretch
            n += w
            su += w * u
            sv += w * v
            suu += w * u * u
            suv += w * u * v
            svv += w * v * v
            sq += w * value
            squ += w * value * u
            sqv += w * value * v
    mu, mv, mq = su / n, sv / n, sq / n
    suu, suv, svv = suu / n - mu * mu, suv / n - mu * mv, svv / n - mv * mv
    squ, sqv = squ / n - mq * mu, sqv / n - mq * mv
    determinant = suu * svv - suv * suv
    if n < _FEWEST or determinant < _LEAST_SPREAD:
        return 1.0, 0.0, 0.0
    beta, gamma = (svv * squ - suv * sqv) / determinant, (suu * sqv - suv * squ) / determinant
    return 1.0 + mq - beta * mu - gamma * mv, beta, gamma


@njit(cache=True, error_model="numpy", nogil=True)
def fit_planes(inverse, first, rows, offsets, stretches, max_step, planes):  # type: ignore[no-untyped-def]
    """Write the planes of some rows, (3, H, W) float32; 0, the plane at infinity, where the range is not known.

    Args:
        inverse: (H, W) float32 1 / range, NaN where not known.
        first: the first row.
        rows: how many.
        offsets: (H, side) int64 columns of the window.
        stretches: (H,) float64 columns that make a step in u.
        max_step: see `fit_slopes`.
        planes: (3, H, W) float32, written.
    """
    height, width = inverse.shape
    basis, plane = np.empty((3, 3)), np.empty(3)
    for row in range(first, first + rows):
        for column in range(width):
            q = np.float64(inverse[row, column])
            plane[:] = 0.0
            if np.isfinite(q):
                alpha, beta, gamma = fit_slopes(inverse, row, column, offsets[row], stretches[row], max_step)
                tangent_basis(row, column, height, width, stretches[row], basis)
                plane_from_slopes(q * alpha, q * beta, q * gamma, basis, plane)
            for a in range(3):
                planes[a, row, column] = _F(plane[a])
