"""Compiled: match planes through the pixels of part of a row with the sources, with the slopes of the match.

A plane p holds the points X with p · X = 1, so that a ray d meets it at 1 / range = p · d, and a source sees the ray in
the direction (R + t pᵀ) d: a homography of rays. The pixels of a stretch are computed together, one window sample at
a time, in short separate loops (project, gather, blend, sum), as in the sweep.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import inlined, kernel
from pano_mvs.geometry.kernels_sphere import elevation_from_y, fast_azimuth, fast_dip, wrapped_column, wrapped_row

# Parts of red, green and blue in 10,000; levels are in 1/256.
_RED, _GREEN, _BLUE, _WHOLE, _FINE = 2126, 7152, 722, 10000, 256
# Levels of `pad_grey` are in 1/128; the highest bit marks pixels that do not count.
_COARSE, _MARK, _LEVEL = 128, 32768, 32767


@kernel
def pack_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return all 2×2 patches of the grey levels of a picture, (H, W, 3) to (H + 1, W + 1), over the seam and the poles.

    Patch (j, i) is upper left | lower left << 16 | upper right << 32 | lower right << 48 of rows j − 1, j and columns
    i − 1, i, in 1/256 grey levels, rounded.
    """
    height, width, _ = picture.shape
    grey = np.empty((height, width), np.uint64)
    for row in range(height):
        for column in range(np.uint64(width)):
            red, green, blue = picture[row, column, 0], picture[row, column, 1], picture[row, column, 2]
            level = np.int32(_RED) * red + np.int32(_GREEN) * green + np.int32(_BLUE) * blue
            grey[row, column] = (np.uint32(level) * np.uint32(_FINE) + np.uint32(_WHOLE // 2)) // np.uint32(_WHOLE)
    packed = np.empty((height + 1, width + 1), np.uint64)
    for j in range(height + 1):
        upper, lower = wrapped_row(j - 1, height), wrapped_row(j, height)
        for i in range(width + 1):
            upper_left, upper_right = (
                wrapped_column(j - 1, i - 1, height, width),
                wrapped_column(j - 1, i, height, width),
            )
            lower_left, lower_right = wrapped_column(j, i - 1, height, width), wrapped_column(j, i, height, width)
            left = grey[upper, upper_left] | grey[lower, lower_left] << np.uint64(16)
            right = grey[upper, upper_right] | grey[lower, lower_right] << np.uint64(16)
            packed[j, i] = left | right << np.uint64(32)
    return packed


@kernel
def pad_grey(picture: NDArray[np.uint8], votes: NDArray[np.bool_], padded: NDArray[np.uint16]) -> None:
    """Write the grey levels of a picture, (H, W, 3) to (H + 2, W + 2), one pixel over the seam and the poles.

    It holds the patches of `pack_grey` in a quarter of the memory, in 1/128 grey levels: (j, i) to (j + 1, i + 1) are
    those of patch (j, i). Pixels that do not count, (H, W) False, are marked.
    """
    height, width, _ = picture.shape
    for j in range(height + 2):
        row = wrapped_row(j - 1, height)
        for i in range(width + 2):
            column = wrapped_column(j - 1, i - 1, height, width)
            red, green, blue = picture[row, column, 0], picture[row, column, 1], picture[row, column, 2]
            level = np.int32(_RED) * red + np.int32(_GREEN) * green + np.int32(_BLUE) * blue
            rounded = (np.uint32(level) * np.uint32(_COARSE) + np.uint32(_WHOLE // 2)) // np.uint32(_WHOLE)
            padded[j, i] = rounded | np.uint32(0 if votes[row, column] else _MARK)


Place = tuple[int, int, int, float, int, NDArray[np.int64], NDArray[np.int64]]
Sources = tuple[NDArray[Any], NDArray[np.int64], NDArray[np.int64], FloatArray, NDArray[np.uint8], NDArray[np.int64]]

_F = np.float32
_U = np.uint64
_TINY, _ONE = _F(1e-30), _F(1)
_LOW, _STEP = _U(65535), _F(1 / 256)

# Rows of the sums over a window, per source: samples b (less the reference's mean), products with the reference a
# (centred), and their slopes g = db / dq against the inverse range q, with the basis f = (1, columns, rows).
SUM_B, SUM_BB, SUM_AB = 0, 1, 2
SUM_G, SUM_GG, SUM_GB, SUM_GA = 3, 6, 12, 15
SUMS = 18

STRETCH = 256
"""Number of pixels of a row that are computed together, so that their sums fit the cache."""


@kernel
def weigh_window(
    grey: NDArray[np.float32],
    place: Place,
    color_scale: np.float32,
    weights: NDArray[np.float32],
    centred: NDArray[np.float32],
    moments: NDArray[np.float32],
) -> None:
    """Weight the window samples of a stretch of pixels by their similarity to the window's centre.

    `grey`: (H + 2 pad, W + 2 pad) float32. `place`: row, first column, H, columns a step, pad, (side,) rows and (side,)
    columns of the window. `color_scale`: 1 / the difference of grey levels at which the weight is halved. `weights`:
    (side², n) float32, written; they sum to 1. `centred`: (side², n) float32, written: the samples less their mean.
    `moments`: (2, n) float32, written: mean and variance.
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


@kernel
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


@kernel
def project_samples(
    azimuth: NDArray[np.float32],
    first: int,
    inverse: NDArray[np.float32],
    matrix: NDArray[np.float32],
    shape: NDArray[np.int64],
    index: NDArray[np.int32],
    placed: NDArray[np.float32],
) -> None:
    """Project rays of one row, at inverse ranges q, into a packed source, with the derivative by q.

    `azimuth`: (2, ·) float32 sin θ and cos θ of the columns. `first`: the first column. `inverse`: (n,) float32 q.
    `matrix`: (3, 4) float32: direction = matrix @ (sin θ, cos θ, 1, q). `shape`: (3,) int64 rows and columns of the
    source, and columns of its array. `index`: (n,) int32, written: position in the packed source. `placed`: (4 ·
    STRETCH,) float32, written: weights of the right and of the lower neighbours, dx/dq and dy/dq in pixels.
    """
    m00, m01, o0, t0 = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    m10, m11, o1, t1 = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    m20, m21, o2, t2 = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    x_scale, y_scale = _F(shape[1] / (2 * np.pi)), _F(shape[0] / np.pi)
    x_middle, y_middle = _F(shape[1] / 2 + 0.5), _F(shape[0] / 2 + 0.5)
    stride = np.int32(shape[2])
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
        placed[i] = px - _F(column)
        placed[i + _U(STRETCH)] = py - _F(row)
        placed[i + _U(2 * STRETCH)] = x_scale * (z * t0 - x * t2) / level_squared
        placed[i + _U(3 * STRETCH)] = y_scale * (level * t1 - y * (x * t0 + z * t2) / level) / (level_squared + y * y)


@kernel
def gather_samples(
    packed: NDArray[np.uint64], start: int, index: NDArray[np.int32], patches: NDArray[np.uint64]
) -> None:
    """Fetch the 2×2 patches, four numbers of 16 bits each, at `start + index`; all (n,) but `packed`."""
    base = _U(start)
    for i in range(_U(index.shape[0])):
        patches[i] = packed[base + _U(index[i])]


@kernel
def gather_grey(
    grey: NDArray[np.uint16], start: int, stride: int, index: NDArray[np.int32], patches: NDArray[np.uint64]
) -> None:
    """Fetch the patches of `gather_samples`, doubled, from pictures of `pad_grey`, whose rows are `stride` apart."""
    upper, lower, level, next_column = _U(start), _U(start + stride), _U(_LEVEL), _U(1)
    for i in range(_U(index.shape[0])):
        above, below = upper + _U(index[i]), lower + _U(index[i])
        left = (_U(grey[above]) & level) | (_U(grey[below]) & level) << _U(16)
        right = (_U(grey[above + next_column]) & level) | (_U(grey[below + next_column]) & level) << _U(16)
        patches[i] = (left | right << _U(32)) << _U(1)


@inlined
def may_count(grey: NDArray[np.uint16], start: int, stride: int) -> bool:
    """Return whether no pixel of the patch that begins at `start` of a picture of `pad_grey` is marked."""
    upper, lower = _U(start), _U(start + stride)
    marks = (_U(grey[upper]) | _U(grey[upper + _U(1)])) | (_U(grey[lower]) | _U(grey[lower + _U(1)]))
    return bool(marks < _U(_MARK))


@kernel
def add_samples(
    patches: NDArray[np.uint64],
    placed: NDArray[np.float32],
    window: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    position: tuple[np.float32, np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Blend 2×2 patches into samples b, with slopes g along the epipolar curve against q, and add them to the sums.

    The sums are one array, whose rows are a constant apart: the loop is only vectorised if few arrays have to be
    proved not to overlap.

    `patches`: (n,) uint64 of one window sample of each pixel. `placed`: see `project_samples`. `window`: (n,) float32
    weights and centred samples of the reference, and means, which are subtracted from b. `position`: columns u and rows
    v of the sample from the centre. `sums`: (SUMS · STRETCH,) float32 of one source, added to.
    """
    weights, reference, means = window
    u, v = position
    uu, uv, vv = u * u, u * v, v * v
    row = _U(STRETCH)
    for i in range(_U(patches.shape[0])):
        patch = patches[i]
        upper_left = _F(np.int32(patch & _LOW)) * _STEP
        lower_left = _F(np.int32((patch >> _U(16)) & _LOW)) * _STEP
        upper_right = _F(np.int32((patch >> _U(32)) & _LOW)) * _STEP
        lower_right = _F(np.int32(patch >> _U(48))) * _STEP
        wx, wy = placed[i], placed[i + row]
        left = upper_left + wy * (lower_left - upper_left)
        right = upper_right + wy * (lower_right - upper_right)
        down_left, down_right = lower_left - upper_left, lower_right - upper_right
        b = left + wx * (right - left) - means[i]
        down = down_left + wx * (down_right - down_left)
        g = placed[i + _U(2) * row] * (right - left) + placed[i + _U(3) * row] * down
        a, wb, wg = reference[i], weights[i] * b, weights[i] * g
        wgg, wgb, wga = wg * g, wg * b, wg * a
        sums[i] += wb
        sums[i + row] += wb * b
        sums[i + _U(2) * row] += wb * a
        sums[i + _U(3) * row] += wg
        sums[i + _U(4) * row] += u * wg
        sums[i + _U(5) * row] += v * wg
        sums[i + _U(6) * row] += wgg
        sums[i + _U(7) * row] += u * wgg
        sums[i + _U(8) * row] += v * wgg
        sums[i + _U(9) * row] += uu * wgg
        sums[i + _U(10) * row] += uv * wgg
        sums[i + _U(11) * row] += vv * wgg
        sums[i + _U(12) * row] += wgb
        sums[i + _U(13) * row] += u * wgb
        sums[i + _U(14) * row] += v * wgb
        sums[i + _U(15) * row] += wga
        sums[i + _U(16) * row] += u * wga
        sums[i + _U(17) * row] += v * wga


@inlined
def row_matrix(pose: FloatArray, elevation: float, matrix: NDArray[np.float32]) -> None:
    """Write the (3, 4) matrix that takes (sin θ, cos θ, 1, q) of a row to directions in a source of pose (3, 4)."""
    level, dip = np.cos(elevation), -np.sin(elevation)
    for a in range(3):
        matrix[a, 0] = _F(level * pose[a, 0])
        matrix[a, 1] = _F(level * pose[a, 2])
        matrix[a, 2] = _F(dip * pose[a, 1])
        matrix[a, 3] = _F(pose[a, 3])


@kernel
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

    `planes`: (3, n) float32. `place`: row, first column, H, columns a step, pad, (side,) rows and (side,) columns of
    the window. `azimuth`: (2, W + 2 pad) float32 sin θ and cos θ of the columns. `window`: weights and centred samples,
    (side², n) float32, and means (n,), of the reference. `sources`: (·,) pictures of `pack_grey` or of `pad_grey`, (S,)
    where each begins, (S, 3) their sizes and the columns of their arrays, (S, 3, 4) float64 source_from_reference, (·,)
    uint8 which patches of `pack_grey` count, empty if all do, and (S,) where each begins. `sums`: (S, SUMS, STRETCH)
    float32, written. `votes`: (S, n) bool, written: True where the source counts for the pixel.
    """
    row, first, height, stretch, pad, rows, columns = place
    weights, centred, means = window
    packed, starts, shapes, poses, valid, valid_starts = sources
    n, side = planes.shape[1], len(rows)
    inverse = np.empty((side * side, n), np.float32)
    index, patches = np.empty(n, np.int32), np.empty(n, np.uint64)
    placed = np.empty(4 * STRETCH, np.float32)
    matrix = np.empty((3, 4), np.float32)
    sums[:] = _F(0)
    for k in range(side * side):
        elevation, start = elevation_from_y(row + rows[k // side] + 0.5, height), pad + first + columns[k % side]
        inverse_ranges(planes, azimuth, start, _F(np.cos(elevation)), _F(-np.sin(elevation)), inverse[k])
    for s in range(len(starts)):  # one after the other: its sums stay in the nearest cache
        for k in range(side * side):
            v, column = rows[k // side], columns[k % side]
            row_matrix(poses[s], elevation_from_y(row + v + 0.5, height), matrix)
            project_samples(azimuth, pad + first + column, inverse[k], matrix, shapes[s], index, placed)
            is_packed = shapes[s, 2] == shapes[s, 1] + 1
            if is_packed:
                gather_samples(packed, starts[s], index, patches)
            else:
                gather_grey(packed, starts[s], shapes[s, 2], index, patches)
            add_samples(
                patches, placed, (weights[k], centred[k], means), (_F(column / stretch), _F(v)), sums[s].reshape(-1)
            )
            if v == 0 and column == 0:
                for i in range(n):
                    if is_packed:
                        votes[s, i] = len(valid) == 0 or valid[_U(valid_starts[s]) + _U(index[i])] != 0
                    else:
                        votes[s, i] = may_count(packed, starts[s] + index[i], shapes[s, 2])
