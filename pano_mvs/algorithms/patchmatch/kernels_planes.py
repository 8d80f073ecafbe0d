"""Compiled: planes through the points around each pixel of a range map.

A plane p holds the points X with p · X = 1, so that a ray d meets it where 1 / range = p · d: planes are linear in the
inverse range q. Around a pixel q = α + β u + γ v, with u in columns (widened away from the equator) and v in rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import azimuth_from_x, elevation_from_y, wrapped_column, wrapped_row

FloatArray = NDArray[np.float64]

_F = np.float32
_U = np.uint64
# Number of pixels of a row whose planes are fitted together, so that their windows fit the cache.
_STRETCH = 128
# Minimum weight of the pixels of a plane, and minimum determinant of their covariance in u and v.
_MIN_WEIGHT, _MIN_SPREAD = 5.0, 0.25


@kernel
def sines_of_columns(width: int) -> FloatArray:
    """Return the sine and the cosine of the azimuth of each column, (2, W)."""
    turned = np.empty((2, width))
    for x in range(width):
        azimuth = azimuth_from_x(x + 0.5, width)
        turned[0, x], turned[1, x] = np.sin(azimuth), np.cos(azimuth)
    return turned


@kernel
def _padded_rows(inverse: NDArray[np.float32], first: int, rows: int, pad: int) -> NDArray[np.float32]:
    """Return some rows of an image with `pad` columns more on either side, beyond the poles and the seam too."""
    height, width = inverse.shape
    padded = np.empty((rows, width + 2 * pad), np.float32)
    for y in range(rows):
        row = wrapped_row(first + y, height)
        for x in range(width + 2 * pad):
            padded[y, x] = inverse[row, wrapped_column(first + y, x - pad, height, width)]
    return padded


@kernel
def _weigh(
    values: FloatArray, k: int, u: float, v: float, reach: float, slopes: FloatArray, products: FloatArray
) -> None:
    """Write Tukey's weights of one neighbour of each pixel, and those times its value, (2, n)."""
    neighbour = _U(k)
    for i in range(_U(values.shape[1])):
        value = values[neighbour, i]
        deviation = (value - slopes[0, i] - slopes[1, i] * u - slopes[2, i] * v) / reach
        rest = 1 - deviation * deviation
        inside = rest > 0  # NaN is not
        products[0, i] = rest * rest if inside else 0.0
        products[1, i] = rest * rest * value if inside else 0.0


@kernel
def _add_first(products: FloatArray, row: int, u: float, v: float, sums: FloatArray, first: int) -> None:
    """Add a row of `products`, alone and times u and v, to three rows of `sums` from `first` on."""
    p, s = _U(row), _U(first)
    for i in range(_U(products.shape[1])):
        value = products[p, i]
        sums[s, i] += value
        sums[s + _U(1), i] += value * u
        sums[s + _U(2), i] += value * v


@kernel
def _add_second(products: FloatArray, u: float, v: float, sums: FloatArray) -> None:
    """Add the weights times u², u v and v² to three rows of `sums`."""
    for i in range(_U(products.shape[1])):
        across = products[0, i] * u
        sums[3, i] += across * u
        sums[4, i] += across * v
        sums[5, i] += products[0, i] * v * v


@kernel
def _solve_slopes(sums: FloatArray, slopes: FloatArray) -> None:
    """Write the weighted means' planes (α, β, γ), (3, n), from the nine sums; ill posed ones stay as they are."""
    for i in range(_U(sums.shape[1])):
        n = max(sums[0, i], 1e-30)
        mu, mv, mq = sums[1, i] / n, sums[2, i] / n, sums[6, i] / n
        suu, suv, svv = sums[3, i] / n - mu * mu, sums[4, i] / n - mu * mv, sums[5, i] / n - mv * mv
        squ, sqv = sums[7, i] / n - mq * mu, sums[8, i] / n - mq * mv
        determinant = suu * svv - suv * suv
        if n >= _MIN_WEIGHT and determinant >= _MIN_SPREAD:
            beta, gamma = (svv * squ - suv * sqv) / determinant, (suu * sqv - suv * squ) / determinant
            slopes[0, i] = mq - beta * mu - gamma * mv
            slopes[1, i] = beta
            slopes[2, i] = gamma


@kernel
def weighted_slopes(
    values: FloatArray,
    offsets: NDArray[np.int64],
    stretch: float,
    tolerance: float,
    growth: float,
    slopes: FloatArray,
    scratch: tuple[FloatArray, FloatArray],
) -> None:
    """Improve the planes (α, β, γ) through the windows of a stretch of pixels.

    Weights are Tukey's biweight of the distance from the present planes, which is 0 from `tolerance` plus `growth` per
    step from the centre. The loops over the pixels are short and many, so that all of them are vectorised.

    Args:
        values: (side², n) float64 of the windows.
        offsets: (side,) columns of the window.
        stretch: columns per step in u.
        tolerance: see above.
        growth: see above.
        slopes: (3, n) float64 α, β and γ, updated; those that are ill posed stay as they are.
        scratch: (2, n) and (9, n) float64.
    """
    products, sums = scratch
    side = len(offsets)
    radius = side // 2
    sums[:] = 0.0
    for k in range(side * side):
        step, v = k % side, k // side - radius
        u, reach = offsets[step] / stretch, tolerance + growth * max(abs(step - radius), abs(v))
        _weigh(values, k, u, float(v), reach, slopes, products)
        _add_first(products, 0, u, float(v), sums, 0)
        _add_second(products, u, float(v), sums)
        _add_first(products, 1, u, float(v), sums, 6)
    _solve_slopes(sums, slopes)


@kernel
def fit_slopes(
    padded: NDArray[np.float32],
    place: tuple[int, int, int],
    offsets: NDArray[np.int64],
    stretch: float,
    max_step: float,
    slopes: FloatArray,
) -> None:
    """Write (α, β, γ), (3, n), of the planes through the inverse ranges around pixels, robustly, in units of their own.

    First fit the neighbours that differ from the pixel by less than `max_step` per step plus one, then those within
    `max_step` of that plane. With too few neighbours q stays as it is, and the surface faces the camera.

    Args:
        padded: rows of inverse ranges, see `_padded_rows`.
        place: the row, the first pixel and the number of columns beyond the seam, in `padded`.
        offsets: (side,) columns of the window.
        stretch: columns per step in u.
        max_step: see above.
        slopes: (3, n) float64, written.
    """
    row, first, pad = place
    side, n = len(offsets), slopes.shape[1]
    values, scratch = np.empty((side * side, n)), (np.empty((2, n)), np.empty((9, n)))
    center = _U(first + pad)
    for k in range(side * side):
        y, start = _U(row + k // side - side // 2), _U(first + pad + offsets[k % side])
        for i in range(_U(n)):
            values[_U(k), i] = np.float64(padded[y, start + i]) / np.float64(padded[_U(row), center + i])
    slopes[0] = 1.0
    slopes[1:] = 0.0
    weighted_slopes(values, offsets, stretch, max_step, max_step, slopes, scratch)
    weighted_slopes(values, offsets, stretch, max_step, 0.0, slopes, scratch)


@kernel
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
    radius, pad = offsets.shape[1] // 2, offsets[first : first + rows].max()
    padded = _padded_rows(inverse, first - radius, rows + 2 * radius, pad)
    turned = sines_of_columns(width)
    for row in range(first, first + rows):
        elevation = elevation_from_y(row + 0.5, height)
        level, dip, stretch = np.cos(elevation), np.sin(elevation), stretches[row]
        # The lengths of the ray's derivatives by u and v: (cos θ, 0, −sin θ) and (sin φ sin θ, cos φ, sin φ cos θ).
        across, down = 2 * np.pi / width * level * stretch, np.pi / height
        for start in range(0, width, _STRETCH):
            slopes = np.empty((3, min(_STRETCH, width - start)))
            fit_slopes(padded, (row - first + radius, start, pad), offsets[row], stretch, max_step, slopes)
            for i in range(_U(slopes.shape[1])):
                x = _U(start) + i
                q = np.float64(inverse[row, x])
                s, c = turned[0, x], turned[1, x]
                alpha, beta, gamma = q * slopes[0, i], q * slopes[1, i] / across, q * slopes[2, i] / down
                ahead = alpha * level + gamma * dip
                known = np.isfinite(q)
                planes[0, row, x] = _F(ahead * s + beta * c) if known else _F(0)
                planes[1, row, x] = _F(gamma * level - alpha * dip) if known else _F(0)
                planes[2, row, x] = _F(ahead * c - beta * s) if known else _F(0)
