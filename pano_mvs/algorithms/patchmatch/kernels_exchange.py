"""Compiled: where the points of a source land in the reference, and how well planes match in each source there."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.kernels_match import STRETCH, Sources, row_matrix
from pano_mvs.algorithms.patchmatch.kernels_refine import Reference
from pano_mvs.algorithms.ranges.kernels_agreement import locate_row
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import elevation_from_y, fast_azimuth, fast_dip, pixel_at

Window = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]

_F = np.float32
_U = np.uint64
_TINY, _ONE = _F(1e-30), _F(1)
_LOW, _STEP = _U(65535), _F(1 / 256)
_OUT = _F(-2)  # less than any correlation


@kernel
def land_nearest(
    places: FloatArray, ranges: NDArray[np.float32], first_row: int, nearest: FloatArray, pixels: NDArray[np.int64]
) -> None:
    """Keep the nearest point that lands in each pixel of a view, the first of equals.

    `places`: (3, W) of the points of one row of another view: x, y and distance in this view, see `locate_row`.
    `ranges`: (W,) float32 of the points in the other view, NaN is left out. `first_row`: position of the row's first
    point among the points of the other view. `nearest`: (H, W) updated: distance of the nearest point. `pixels`: (H, W)
    updated: its position; −1 without any.
    """
    height, width = nearest.shape
    for i in range(len(ranges)):
        if math.isfinite(ranges[i]):
            row, column = pixel_at(places[0, i], places[1, i], height, width)
            if pixels[row, column] < 0 or places[2, i] < nearest[row, column]:
                nearest[row, column], pixels[row, column] = places[2, i], first_row + i


@kernel
def land_points(
    ranges: NDArray[np.float32],
    grid: tuple[FloatArray, FloatArray],
    view: tuple[FloatArray, FloatArray],
    nearest: FloatArray,
    pixels: NDArray[np.int64],
) -> None:
    """Write the nearest point of a source that lands in each pixel of the reference.

    `ranges`: (Hs, Ws) float32 of the source, NaN is left out. `grid`: (2, Ws) sin θ and cos θ of its columns, (2, Hs)
    sin φ and cos φ of its rows. `view`: rotation (3, 3) and translation (3,) reference_from_source. `nearest`: (H, W)
    of NaN, written: the distance. `pixels`: (H, W) of −1, written: the flat position in the source.
    """
    turns, elevations = grid
    height, width = ranges.shape
    places = np.empty((3, width))
    for row in range(height):
        elevation = elevations[0, row], elevations[1, row]
        locate_row(ranges[row], turns, elevation, view, nearest.shape, places)
        land_nearest(places, ranges[row], row * width, nearest, pixels)


@kernel
def weigh_windows(
    grey: NDArray[np.float32],
    place: tuple[int, int, NDArray[np.int64], NDArray[np.int64]],
    columns: NDArray[np.int64],
    color_scale: np.float32,
    window: Window,
) -> None:
    """Do what `weigh_window` does for some pixels of a row, (n,) columns; also write sin θ and cos θ of the samples.

    `grey`: (H + 2 pad, W + 2 pad) float32. `place`: row, pad, (side,) rows and (side,) columns of the window.
    `columns`: (n,) of the pixels. `color_scale`: 1 / the difference of grey levels at which the weight is halved.
    `window`: (side², n) float32 weights, which sum to 1, and centred samples, (n,) means, (n,) variances and (n,)
    scratch space; written.
    """
    row, pad, rows, offsets = place
    weights, centred, means, variances, total = window
    side = len(rows)
    means[:], variances[:], total[:] = _F(0), _F(0), _F(0)
    center = _U(pad + row)
    for k in range(side * side):
        y, shift = _U(pad + row + rows[k // side]), pad + offsets[k % side]
        for i in range(_U(len(columns))):
            value = grey[y, _U(columns[i] + shift)]
            difference = (value - grey[center, _U(columns[i] + pad)]) * color_scale
            weight = _ONE / (_ONE + difference * difference)
            weights[k, i] = weight
            centred[k, i] = value
            total[i] += weight
            means[i] += weight * value
    for i in range(_U(len(columns))):
        total[i] = _ONE / total[i]
        means[i] *= total[i]
    for k in range(side * side):
        for i in range(_U(len(columns))):
            weight = weights[k, i] * total[i]
            value = centred[k, i] - means[i]
            weights[k, i] = weight
            centred[k, i] = value
            variances[i] += weight * value * value


@kernel
def aim_samples(
    planes: NDArray[np.float32],
    columns: NDArray[np.int64],
    azimuth: NDArray[np.float32],
    place: tuple[int, int, int, NDArray[np.int64], NDArray[np.int64]],
    turns: NDArray[np.float32],
    inverse: NDArray[np.float32],
) -> None:
    """Write where the rays of window samples point, and where they meet the planes of their pixels.

    `planes`: (3, n) float32. `columns`: (n,) of the pixels. `azimuth`: (2, W + 2 pad) float32 sin θ and cos θ of the
    columns. `place`: row, H, pad, (side,) rows and (side,) columns of the window. `turns`: (side, 2, n) float32,
    written: sin θ and cos θ of the samples in each column of the window. `inverse`: (side², n) float32, written: q = p
    · d.
    """
    row, height, pad, rows, offsets = place
    side = len(rows)
    for u in range(side):
        shift = pad + offsets[u]
        for i in range(_U(len(columns))):
            turns[u, 0, i], turns[u, 1, i] = azimuth[0, _U(columns[i] + shift)], azimuth[1, _U(columns[i] + shift)]
    for k in range(side * side):
        elevation, u = elevation_from_y(row + rows[k // side] + 0.5, height), k % side
        level, dip = _F(np.cos(elevation)), _F(-np.sin(elevation))
        for i in range(_U(len(columns))):
            across = planes[0, i] * turns[u, 0, i] + planes[2, i] * turns[u, 1, i]
            inverse[k, i] = level * across + dip * planes[1, i]


@kernel
def place_samples(
    turns: NDArray[np.float32],
    inverse: NDArray[np.float32],
    matrix: NDArray[np.float32],
    shape: NDArray[np.int64],
    index: NDArray[np.int32],
    blend: NDArray[np.float32],
) -> None:
    """Do what `project_samples` does, without the derivative; `turns` is (2, n) sin θ and cos θ of the rays."""
    m00, m01, o0, t0 = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    m10, m11, o1, t1 = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    m20, m21, o2, t2 = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    x_scale, y_scale = _F(shape[1] / (2 * np.pi)), _F(shape[0] / np.pi)
    x_middle, y_middle = _F(shape[1] / 2 + 0.5), _F(shape[0] / 2 + 0.5)
    stride = np.int32(shape[1] + 1)
    last_row, last_column = np.int32(shape[0]), np.int32(shape[1])
    for i in range(_U(inverse.shape[0])):
        s, c, q = turns[0, i], turns[1, i], inverse[i]
        x = m00 * s + m01 * c + o0 + t0 * q
        y = m10 * s + m11 * c + o1 + t1 * q
        z = m20 * s + m21 * c + o2 + t2 * q
        px = fast_azimuth(x, z) * x_scale + x_middle
        py = fast_dip(y, np.sqrt(x * x + z * z + _TINY)) * y_scale + y_middle
        column, row = np.int32(px), np.int32(py)
        column = last_column if column > last_column else column
        row = last_row if row > last_row else row
        index[i] = np.int32(row * stride + column)
        blend[0, i] = px - _F(column)
        blend[1, i] = py - _F(row)


@kernel
def sum_samples(
    packed: NDArray[np.uint64],
    start: int,
    index: NDArray[np.int32],
    patches: NDArray[np.uint64],
    blend: NDArray[np.float32],
    means: NDArray[np.float32],
    weights: NDArray[np.float32],
    centred: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Blend 2×2 patches of a source into samples b less `means`, and add w b, w b b and w b a to the sums, (3, n)."""
    base = _U(start)
    for i in range(_U(index.shape[0])):
        patches[i] = packed[base + _U(index[i])]
    for i in range(_U(index.shape[0])):
        patch = patches[i]
        upper_left = _F(np.int32(patch & _LOW)) * _STEP
        lower_left = _F(np.int32((patch >> _U(16)) & _LOW)) * _STEP
        upper_right = _F(np.int32((patch >> _U(32)) & _LOW)) * _STEP
        lower_right = _F(np.int32(patch >> _U(48))) * _STEP
        wx, wy = blend[0, i], blend[1, i]
        left = upper_left + wy * (lower_left - upper_left)
        right = upper_right + wy * (lower_right - upper_right)
        b = left + wx * (right - left) - means[i]
        wb = weights[i] * b
        sums[0, i] += wb
        sums[1, i] += wb * b
        sums[2, i] += wb * centred[i]


@kernel
def correlate_pixels(
    rows: tuple[int, int],
    starts: NDArray[np.int64],
    columns: NDArray[np.int64],
    planes: NDArray[np.float32],
    reference: Reference,
    sources: Sources,
    numbers: tuple[np.float32, np.float32],
    correlations: NDArray[np.float32],
) -> None:
    """Write the correlation of each source with the reference, on planes of some pixels.

    `rows`: the first row, and the end. `starts`: (H + 1,) where the pixels of each row begin. `columns`: (N,) of the
    pixels, row after row. `planes`: (3, N) float32, finite. `reference`: see `refine_rows`. `sources`: see
    `sum_windows`. `numbers`: 1 / width in grey levels of the window's weights, and noise. `correlations`: (S, N)
    float32, written; −2 where a source does not count.
    """
    grey, azimuth, pad, stretches, window_rows, window_columns = reference
    packed, packed_starts, shapes, poses, valid, valid_starts = sources
    color_scale, noise = numbers
    height, side = len(stretches), len(window_rows)
    weights, centred = np.empty((side * side, STRETCH), np.float32), np.empty((side * side, STRETCH), np.float32)
    turns, inverse = np.empty((side, 2, STRETCH), np.float32), np.empty((side * side, STRETCH), np.float32)
    rest, matrix = np.empty((8, STRETCH), np.float32), np.empty((3, 4), np.float32)
    index, patches = np.empty(STRETCH, np.int32), np.empty(STRETCH, np.uint64)
    for row in range(rows[0], rows[1]):
        for first in range(starts[row], starts[row + 1], STRETCH):
            n = min(STRETCH, starts[row + 1] - first)
            some, part = columns[first : first + n], planes[:, first : first + n]
            offsets = window_columns[row]
            window = weights[:, :n], centred[:, :n], rest[0, :n], rest[1, :n], rest[2, :n]
            weigh_windows(grey, (row, pad, window_rows, offsets), some, color_scale, window)
            aim_samples(part, some, azimuth, (row, height, pad, window_rows, offsets), turns[:, :, :n], inverse[:, :n])
            blend, sums = rest[3:5, :n], rest[5:8, :n]
            for s in range(len(packed_starts)):
                sums[:] = _F(0)
                for k in range(side * side):
                    row_matrix(poses[s], elevation_from_y(row + window_rows[k // side] + 0.5, height), matrix)
                    place_samples(turns[k % side, :, :n], inverse[k, :n], matrix, shapes[s], index[:n], blend)
                    sum_samples(
                        *(packed, packed_starts[s], index[:n], patches[:n], blend, rest[0, :n]),
                        *(weights[k, :n], centred[k, :n], sums),
                    )
                    if k == side * side // 2:
                        for i in range(n):
                            votes = len(valid) == 0 or valid[_U(valid_starts[s]) + _U(index[i])] != 0
                            correlations[s, first + i] = _ONE if votes else _OUT
                for i in range(n):
                    b = sums[0, i]
                    spread = sums[1, i] - b * b + noise
                    correlation = sums[2, i] / np.sqrt(spread * (rest[1, i] + noise))
                    if correlations[s, first + i] > _OUT:
                        correlations[s, first + i] = correlation
