"""Compiled: match planes through the pixels of part of a row with the sources, with the slopes of the match.

A plane p holds the points X with p · X = 1, so that a ray d meets it at 1 / range = p · d, and a source sees the ray in
the direction (R + t pᵀ) d: a homography of rays. The pixels of a stretch are computed together, one window sample at
a time, in short separate loops (project, gather, blend, sum), as in the sweep.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pano_mvs.geometry.kernels_sphere import elevation_from_y, fast_azimuth, fast_dip

FloatArray = NDArray[np.float64]
Place = tuple[int, int, int, float, int, NDArray[np.int64], NDArray[np.int64]]
Sources = tuple[
    NDArray[np.uint64], NDArray[np.int64], NDArray[np.int64], FloatArray, NDArray[np.uint8], NDArray[np.int64]
]

_F = np.float32
_U = np.uint64
_TINY, _ONE = _F(1e-30), _F(1)
_LOW, _STEP = _U(65535), _F(1 / 256)

# Rows of the sums over a window, per source: samples b (less the reference's mean), products with the reference a
# (centred), and their slopes g = db / dq against the inverse range q, with the basis f = (1, columns, rows).
SUM_B, SUM_BB, SUM_AB = 0, 1, 2
SUM_G, SUM_GG, SUM_GB, SUM_GA = 3, 6, 12, 15
SUMS = 18


@njit(cache=True, error_model="numpy", nogil=True)
def weigh_window(
    grey: NDArray[np.float32],
    place: Place,
    color_scale: np.float32,
    weights: NDArray[np.float32],
    centred: NDArray[np.float32],
    moments: NDArray[np.float32],
) -> None:
    """Weight the window samples of a stretch of pixels by their similarity to the window's centre.

    Args:
        grey: (H + 2 pad, W + 2 pad) float32.
        place: row, first column, H, columns a step, pad, (side,) rows and (side,) columns of the window.
        color_scale: 1 / the difference of grey levels at which the weight is halved.
        weights: (side², n) float32, written; they sum to 1.
        centred: (side², n) float32, written: the samples less their mean.
        moments: (2, n) float32, written: mean and variance.
    """
    row, first, _, _, pad, rows, columns = place
    n, side = weights.shape[1], len(rows)
    moments[:] = _F(0)
    total = np.zeros(n, np.float32)
    center, start = _U(pad + row), _U(pad + first)
    for k in range(side * side):
        y, x = _U(pad + row + rows[k // side]), _U(pad + first + columns[k % side])
        for i in range(_U(n)):
            value = grey[y, x + i]
            difference = (value - grey[center, start + i]) * color_scale
            weight = _ONE / (_ONE + difference * difference)
            weights[k, i] = weight
            centred[k, i] = value
            total[i] += weight
            moments[0, i] += weight * value
    for i in range(_U(n)):
        total[i] = _ONE / total[i]
        moments[0, i] *= total[i]
    for k in range(side * side):
        for i in range(_U(n)):
            weight = weights[k, i] * total[i]
            value = centred[k, i] - moments[0, i]
            weights[k, i] = weight
            centred[k, i] = value
            moments[1, i] += weight * value * value


@njit(cache=True, error_model="numpy", nogil=True)
def inverse_ranges(
    planes: NDArray[np.float32],
    azimuth: NDArray[np.float32],
    first: int,
    level: np.float32,
    dip: np.float32,
    inverse: NDArray[np.float32],
) -> None:
    """Write q = p · d, (n,), for planes (3, n) and rays of one row: sin θ and cos θ from column `first` on."""
    start = _U(first)
    for i in range(_U(inverse.shape[0])):
        across = planes[0, i] * azimuth[0, start + i] + planes[2, i] * azimuth[1, start + i]
        inverse[i] = level * across + dip * planes[1, i]


@njit(cache=True, error_model="numpy", nogil=True)
def project_samples(
    azimuth: NDArray[np.float32],
    first: int,
    inverse: NDArray[np.float32],
    matrix: NDArray[np.float32],
    shape: NDArray[np.int64],
    index: NDArray[np.int32],
    weights: NDArray[np.float32],
    slopes: NDArray[np.float32],
) -> None:
    """Project rays of one row, at inverse ranges q, into a packed source, with the derivative by q.

    Args:
        azimuth: (2, ·) float32 sin θ and cos θ of the columns.
        first: the first column.
        inverse: (n,) float32 q.
        matrix: (3, 4) float32: direction = matrix @ (sin θ, cos θ, 1, q).
        shape: (2,) int64 rows and columns of the source.
        index: (n,) int32, written: position in the packed source.
        weights: (2, n) float32, written: of the right and of the lower neighbours.
        slopes: (2, n) float32, written: dx/dq and dy/dq in pixels.
    """
    m00, m01, o0, t0 = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    m10, m11, o1, t1 = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    m20, m21, o2, t2 = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    x_scale, y_scale = _F(shape[1] / (2 * np.pi)), _F(shape[0] / np.pi)
    x_middle, y_middle = _F(shape[1] / 2 + 0.5), _F(shape[0] / 2 + 0.5)
    stride = np.int32(shape[1] + 1)
    last_row, last_column = np.int32(shape[0]), np.int32(shape[1])
    start = _U(first)
    for i in range(_U(inverse.shape[0])):
        s, c, q = azimuth[0, start + i], azimuth[1, start + i], inverse[i]
        x = m00 * s + m01 * c + o0 + t0 * q
        y = m10 * s + m11 * c + o1 + t1 * q
        z = m20 * s + m21 * c + o2 + t2 * q
        level_squared = x * x + z * z + _TINY
        level = np.sqrt(level_squared)
        px = fast_azimuth(x, z) * x_scale + x_middle
        py = fast_dip(y, level) * y_scale + y_middle
        column, row = np.int32(px), np.int32(py)
        column = last_column if column > last_column else column
        row = last_row if row > last_row else row
        index[i] = np.int32(row * stride + column)
        weights[0, i] = px - _F(column)
        weights[1, i] = py - _F(row)
        slopes[0, i] = x_scale * (z * t0 - x * t2) / level_squared
        slopes[1, i] = y_scale * (level * t1 - y * (x * t0 + z * t2) / level) / (level_squared + y * y)


@njit(cache=True, error_model="numpy", nogil=True)
def gather_samples(
    packed: NDArray[np.uint64], start: int, index: NDArray[np.int32], patches: NDArray[np.uint64]
) -> None:
    """Fetch the 2×2 patches, four numbers of 16 bits each, at `start + index`; all (n,) but `packed`."""
    base = _U(start)
    for i in range(_U(index.shape[0])):
        patches[i] = packed[base + _U(index[i])]


@njit(cache=True, error_model="numpy", nogil=True)
def blend_samples(
    patches: NDArray[np.uint64],
    weights: NDArray[np.float32],
    slopes: NDArray[np.float32],
    means: NDArray[np.float32],
    samples: NDArray[np.float32],
    gradients: NDArray[np.float32],
) -> None:
    """Blend 2×2 patches into samples less `means`, and their slopes along the epipolar curve against q; all (n,)."""
    for i in range(_U(patches.shape[0])):
        patch = patches[i]
        upper_left = _F(np.int32(patch & _LOW)) * _STEP
        lower_left = _F(np.int32((patch >> _U(16)) & _LOW)) * _STEP
        upper_right = _F(np.int32((patch >> _U(32)) & _LOW)) * _STEP
        lower_right = _F(np.int32(patch >> _U(48))) * _STEP
        wx, wy = weights[0, i], weights[1, i]
        left = upper_left + wy * (lower_left - upper_left)
        right = upper_right + wy * (lower_right - upper_right)
        down_left, down_right = lower_left - upper_left, lower_right - upper_right
        samples[i] = left + wx * (right - left) - means[i]
        gradients[i] = slopes[0, i] * (right - left) + slopes[1, i] * (down_left + wx * (down_right - down_left))


@njit(cache=True, error_model="numpy", nogil=True)
def add_samples(
    samples: NDArray[np.float32],
    window_weights: NDArray[np.float32],
    reference: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Add one window sample of each pixel to the sums of one source; (n,) each, sums (SUMS, n)."""
    for i in range(_U(samples.shape[0])):
        b = samples[i]
        wb = window_weights[i] * b
        sums[SUM_B, i] += wb
        sums[SUM_BB, i] += wb * b
        sums[SUM_AB, i] += wb * reference[i]


@njit(cache=True, error_model="numpy", nogil=True)
def weigh_gradients(
    samples: NDArray[np.float32],
    gradients: NDArray[np.float32],
    window_weights: NDArray[np.float32],
    reference: NDArray[np.float32],
    products: NDArray[np.float32],
) -> None:
    """Write w g, w g g, w g b and w g a, (4, n), of the slopes g of one window sample of each pixel, all (n,)."""
    for i in range(_U(samples.shape[0])):
        g = gradients[i]
        wg = window_weights[i] * g
        products[0, i] = wg
        products[1, i] = wg * g
        products[2, i] = wg * samples[i]
        products[3, i] = wg * reference[i]


@njit(cache=True, error_model="numpy", nogil=True)
def add_moments(
    products: NDArray[np.float32],
    row: int,
    factors: tuple[np.float32, np.float32, np.float32],
    sums: NDArray[np.float32],
    first: int,
) -> None:
    """Add a row of `products`, times each of three factors, to three rows of `sums` from `first` on."""
    p, s = _U(row), _U(first)
    f0, f1, f2 = factors
    for i in range(_U(products.shape[1])):
        value = products[p, i]
        sums[s, i] += f0 * value
        sums[s + _U(1), i] += f1 * value
        sums[s + _U(2), i] += f2 * value


@njit(cache=True, error_model="numpy", nogil=True)
def add_gradients(products: NDArray[np.float32], u: np.float32, v: np.float32, sums: NDArray[np.float32]) -> None:
    """Add what `weigh_gradients` wrote of one window sample, at columns u and rows v from the centre, to the sums.

    One loop over all of it would not be vectorised: too many rows would have to be proved not to overlap.
    """
    basis = _ONE, u, v
    add_moments(products, 0, basis, sums, SUM_G)
    add_moments(products, 1, basis, sums, SUM_GG)
    add_moments(products, 1, (u * u, u * v, v * v), sums, SUM_GG + 3)
    add_moments(products, 2, basis, sums, SUM_GB)
    add_moments(products, 3, basis, sums, SUM_GA)


@njit(cache=True, error_model="numpy", nogil=True)
def row_matrix(pose: FloatArray, elevation: float, matrix: NDArray[np.float32]) -> None:
    """Write the (3, 4) matrix that takes (sin θ, cos θ, 1, q) of a row to directions in a source of pose (3, 4)."""
    level, dip = np.cos(elevation), -np.sin(elevation)
    for a in range(3):
        matrix[a, 0] = _F(level * pose[a, 0])
        matrix[a, 1] = _F(level * pose[a, 2])
        matrix[a, 2] = _F(dip * pose[a, 1])
        matrix[a, 3] = _F(pose[a, 3])


@njit(cache=True, error_model="numpy", nogil=True)
def sum_windows(
    planes: NDArray[np.float32],
    place: Place,
    azimuth: NDArray[np.float32],
    window: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    sources: Sources,
    sums: NDArray[np.float32],
    votes: NDArray[np.bool_],
) -> None:
    """Sum up the windows of a stretch of pixels, on their planes, over each source.

    Args:
        planes: (3, n) float32.
        place: row, first column, H, columns a step, pad, (side,) rows and (side,) columns of the window.
        azimuth: (2, W + 2 pad) float32 sin θ and cos θ of the columns.
        window: weights and centred samples, (side², n) float32, and means (n,), of the reference.
        sources: (·,) uint64 packed pictures, (S,) where each begins, (S, 2) their sizes, (S, 3, 4) float64
            source_from_reference, (·,) uint8 which patches count, empty if all do, and (S,) where each begins.
        sums: (S, SUMS, n) float32, written.
        votes: (S, n) bool, written: True where the source counts for the pixel.
    """
    row, first, height, stretch, pad, rows, columns = place
    weights, centred, means = window
    packed, starts, shapes, poses, valid, valid_starts = sources
    n, side = planes.shape[1], len(rows)
    inverse = np.empty((side * side, n), np.float32)
    values, gradients, products = np.empty(n, np.float32), np.empty(n, np.float32), np.empty((4, n), np.float32)
    index, patches = np.empty(n, np.int32), np.empty(n, np.uint64)
    blend, slopes = np.empty((2, n), np.float32), np.empty((2, n), np.float32)
    matrix = np.empty((3, 4), np.float32)
    sums[:] = _F(0)
    for k in range(side * side):
        elevation, start = elevation_from_y(row + rows[k // side] + 0.5, height), pad + first + columns[k % side]
        inverse_ranges(planes, azimuth, start, _F(np.cos(elevation)), _F(-np.sin(elevation)), inverse[k])
    for s in range(len(starts)):  # one after the other: its sums stay in the nearest cache
        for k in range(side * side):
            v, column = rows[k // side], columns[k % side]
            row_matrix(poses[s], elevation_from_y(row + v + 0.5, height), matrix)
            project_samples(azimuth, pad + first + column, inverse[k], matrix, shapes[s], index, blend, slopes)
            gather_samples(packed, starts[s], index, patches)
            blend_samples(patches, blend, slopes, means, values, gradients)
            add_samples(values, weights[k], centred[k], sums[s])
            weigh_gradients(values, gradients, weights[k], centred[k], products)
            add_gradients(products, _F(column / stretch), _F(v), sums[s])
            if v == 0 and column == 0:
                for i in range(n):
                    votes[s, i] = len(valid) == 0 or valid[_U(valid_starts[s]) + _U(index[i])] != 0
