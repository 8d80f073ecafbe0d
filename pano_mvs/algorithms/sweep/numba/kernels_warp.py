"""Compiled: sample one source for a row of the reference at one depth hypothesis.

Rows are computed in short separate loops (project, gather, blend) over arrays of one row: a loop that both gathers and
stores cannot be proved free of aliasing, and is then not vectorised. Loop variables are unsigned, since numba checks
signed ones for negative indices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I32, I64, U8, U32
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import fast_azimuth, fast_dip

_F = np.float32
_U = np.uint64
_HALF = _F(0.5)
# Weights in integers, see `blend_row`.
UNIT, HALFWAY_SHIFT, SHIFT = 16384, 6, 22
HALFWAY_ROUND, ROUND = 1 << (HALFWAY_SHIFT - 1), 1 << (SHIFT - 1)


@kernel
def project_row(
    sin_cos_azimuth: F32, matrix: F32, offset: F32, shape: I64, start: int, stop: int, x_px: F32, y_px: F32
) -> None:
    """Find where the columns `start` … `stop` − 1 of a row of rays, of azimuth θ, arrive in a packed source.

    Args:
        sin_cos_azimuth: (2, W) float32 sin θ and cos θ.
        matrix: (3, 2) float32: x_in_source = matrix @ (sin θ, cos θ) + offset, of any positive length.
        offset: (3,) float32.
        shape: (2,) int64 rows and columns of the source picture.
        start: the first column.
        stop: the column after the last.
        x_px: (W,) float32, written: ½ to columns + ½, the position among the packed patches.
        y_px: (W,) float32, written: ½ to rows + ½.
    """
    m00, m01, o0 = matrix[0, 0], matrix[0, 1], offset[0]
    m10, m11, o1 = matrix[1, 0], matrix[1, 1], offset[1]
    m20, m21, o2 = matrix[2, 0], matrix[2, 1], offset[2]
    x_scale, y_scale = _F(shape[1] / (2 * np.pi)), _F(shape[0] / np.pi)
    x_middle, y_middle = _F(shape[1] / 2 + 0.5), _F(shape[0] / 2 + 0.5)
    for i in range(_U(start), _U(stop)):
        s, c = sin_cos_azimuth[0, i], sin_cos_azimuth[1, i]
        x = m00 * s + m01 * c + o0
        y = m10 * s + m11 * c + o1
        z = m20 * s + m21 * c + o2
        x_px[i] = fast_azimuth(x, z) * x_scale + x_middle
        y_px[i] = fast_dip(y, np.sqrt(x * x + z * z)) * y_scale + y_middle


@kernel
def place_row(x_px: F32, y_px: F32, shape: I64, index: I32, weight_x: I32, weight_y: I32) -> None:
    """Turn positions among packed patches into an index and integer weights.

    Args:
        x_px: (W,) float32, less than one turn away from where `project_row` puts it.
        y_px: (W,) float32.
        shape: (2,) int64 of the source picture.
        index: (W,) int32, written: of the patch, in rows of columns + 2.
        weight_x: (W,) int32, written: two words, left and right, of 16384 in all.
        weight_y: (W,) int32, written: likewise upper and lower.
    """
    turn, least, last = _F(shape[1]), _HALF, _F(shape[1] + 0.5)
    stride = np.int32(shape[1] + 2)
    last_row, last_column = np.int32(shape[0]), np.int32(shape[1])
    for i in range(_U(index.shape[0])):
        x, y = x_px[i], y_px[i]
        x = x + turn if x < least else x
        x = x - turn if x >= last else x
        column, row = np.int32(x), np.int32(y)
        column = min(max(column, np.int32(0)), last_column)
        row = min(max(row, np.int32(0)), last_row)
        right = np.int32((x - _F(column)) * _F(UNIT) + _HALF)
        lower = np.int32((y - _F(row)) * _F(UNIT) + _HALF)
        index[i] = np.int32(row * stride + column)
        weight_x[i] = np.int32(np.int32(UNIT) + right * np.int32(65535))
        weight_y[i] = np.int32(np.int32(UNIT) + lower * np.int32(65535))


@kernel
def gather_row(packed: U32, start: int, index: I32, patches: U32) -> None:
    """Fetch the 2×2 patches, packed as four bytes, at `start + index`; all (W,) but `packed`."""
    base = _U(start)
    for i in range(_U(index.shape[0])):
        patches[i] = packed[base + _U(index[i])]


@kernel
def blend_row(patches: U32, weight_x: I32, weight_y: I32, out: U8, out_at: int) -> None:
    """Blend 2×2 patches bilinearly into `out[out_at:out_at + W]`, uint8, rounded.

    A patch holds values less 128 in four signed bytes, upper left, lower left, upper right and lower right. Weights are
    in 1/16384; between rows and columns there are 8 bits behind the point.
    """
    word = np.int32(65535)
    for i in range(_U(patches.shape[0])):
        patch, across, down = np.int32(patches[i]), weight_x[i], weight_y[i]
        upper, lower = np.int32(down & word), np.int32(down >> np.int32(16))
        upper_left = np.int32(np.int32(patch << np.int32(24)) >> np.int32(24))
        lower_left = np.int32(np.int32(patch << np.int32(16)) >> np.int32(24))
        upper_right = np.int32(np.int32(patch << np.int32(8)) >> np.int32(24))
        lower_right = np.int32(patch >> np.int32(24))
        left = np.int32(upper * upper_left + lower * lower_left + np.int32(HALFWAY_ROUND))
        right = np.int32(upper * upper_right + lower * lower_right + np.int32(HALFWAY_ROUND))
        left, right = np.int32(left >> np.int32(HALFWAY_SHIFT)), np.int32(right >> np.int32(HALFWAY_SHIFT))
        blended = np.int32(left * np.int32(across & word) + right * np.int32(across >> np.int32(16)))
        blended = np.int32(np.int32(blended + np.int32(ROUND)) >> np.int32(SHIFT))
        out[_U(out_at) + i] = np.uint8(blended + np.int32(128))


@kernel
def wrap_row(row: NDArray[Any], width: int, pad: int) -> None:
    """Fill the `pad` entries on either side of `row[pad:pad + width]` over the seam."""
    for i in range(pad):
        row[i] = row[width + i]
        row[pad + width + i] = row[pad + i]
