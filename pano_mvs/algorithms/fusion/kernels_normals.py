"""Compiled: the plane through the points around each pixel of a range map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import wrapped_column, wrapped_row

FloatArray = NDArray[np.float64]


@kernel
def solve_symmetric(a: FloatArray, b: FloatArray) -> tuple[float, float, float, bool]:
    """Return the solution of a symmetric 3×3 system, a = (xx, xy, xz, yy, yz, zz), and whether it is well posed."""
    c00, c01, c02 = a[3] * a[5] - a[4] * a[4], a[2] * a[4] - a[1] * a[5], a[1] * a[4] - a[2] * a[3]
    determinant = a[0] * c00 + a[1] * c01 + a[2] * c02
    trace = a[0] + a[3] + a[5]
    if not determinant > 1e-14 * trace * trace * trace:
        return 0.0, 0.0, 0.0, False
    c11, c12, c22 = a[0] * a[5] - a[2] * a[2], a[1] * a[2] - a[0] * a[4], a[0] * a[3] - a[1] * a[1]
    x = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
    y = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant
    z = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant
    return x, y, z, True


@kernel
def fit_plane(
    inverse: FloatArray,
    rays: FloatArray,
    row: int,
    column: int,
    stretch: int,
    radius: int,
    max_step: float,
    a: FloatArray,
    b: FloatArray,
) -> tuple[float, float, float, bool]:
    """Return (x, y, z, ok) of the plane p with p · ray = 1 / range around a pixel, in units of its own 1 / range.

    `a` (6,) and `b` (3,) are scratch space.
    """
    height, width = inverse.shape
    center = inverse[row, column]
    a[:] = 0.0
    b[:] = 0.0
    count = 0
    for d_row in range(-radius, radius + 1):
        for d_column in range(-radius, radius + 1):
            other_row = wrapped_row(row + d_row, height)
            other_column = wrapped_column(row + d_row, column + d_column * stretch, height, width)
            value = inverse[other_row, other_column] / center
            steps = max(abs(d_row), abs(d_column))
            deviation = abs(value - 1) / (max_step * max(steps, 1))
            if not deviation < 1:  # NaN included
                continue
            weight = (1 - deviation * deviation) ** 2
            ray = rays[other_row, other_column]
            x, y, z = ray[0], ray[1], ray[2]
            a[0] += weight * x * x
            a[1] += weight * x * y
            a[2] += weight * x * z
            a[3] += weight * y * y
            a[4] += weight * y * z
            a[5] += weight * z * z
            b[0] += weight * value * x
            b[1] += weight * value * y
            b[2] += weight * value * z
            count += 1
    # Three points may lie on a line; half of the smallest window cannot.
    if count < 5:
        return 0.0, 0.0, 0.0, False
    plane: tuple[float, float, float, bool] = solve_symmetric(a, b)
    return plane


@kernel
def fit_normals(
    pixels: tuple[FloatArray, FloatArray, NDArray[np.bool_]],
    stretches: NDArray[np.int64],
    radius: int,
    max_step: float,
    rows: tuple[int, int],
    normals: NDArray[np.float32],
) -> None:
    """Write unit normals towards the camera of the rows [first, end) into (H, W, 3) float32.

    `pixels` is (inverse ranges, rays, bool where a normal is wanted), (H, W, ...). Pixels that already have a
    normal keep it; nothing is written where the plane is undefined.
    """
    inverse, rays, wanted = pixels
    a, b = np.empty(6), np.empty(3)
    for row in range(rows[0], rows[1]):
        for column in range(inverse.shape[1]):
            open_yet = wanted[row, column] and not math.isfinite(normals[row, column, 0])
            if open_yet and math.isfinite(inverse[row, column]):
                x, y, z, ok = fit_plane(inverse, rays, row, column, stretches[row], radius, max_step, a, b)
                length = math.sqrt(x * x + y * y + z * z)
                if ok and length > 0:
                    # p · ray > 0 at the surface, so −p points towards the camera.
                    normals[row, column, 0] = -x / length
                    normals[row, column, 1] = -y / length
                    normals[row, column, 2] = -z / length
