"""Compiled: truncated differences of colour and of gradient, alone and beside census."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.costs.kernels_constants import GREY_WEIGHT, MAX_COLOR_COST, MAX_GRADIENT_COST
from pano_mvs.algorithms.sweep.numba.kernels_census import count_census_row
from pano_mvs.algorithms.sweep.numba.kernels_cost import difference_row
from pano_mvs.algorithms.sweep.numba.kernels_records import I64, U8, U16
from pano_mvs.core.kernels import inlined, kernel

_I = np.int16
_U = np.uint64
_LARGEST_LEVEL, _LARGEST_GRADIENT = _I(MAX_COLOR_COST // 3), _I(MAX_GRADIENT_COST // 3)


@kernel
def gradient_row(
    reference: U8, reference_row: int, warped: U8, warped_row: int, reach: int, pad: int, total: U16
) -> None:
    """Add |∂x r − ∂x w| + |∂y r − ∂y w| of one row of one colour to `total`, (W,) uint16.

    Central differences, not halved: over two rows, and over `reach` columns on either side.
    """
    r, w = _U(reference_row), _U(warped_row)
    r_up, r_down = _U(reference_row - 1), _U(reference_row + 1)
    w_up, w_down = _U(warped_row - 1), _U(warped_row + 1)
    left, middle, right = _U(pad - reach), _U(pad), _U(pad + reach)
    for i in range(_U(total.shape[0])):
        across = np.int32(reference[r, right + i]) - np.int32(reference[r, left + i])
        across -= np.int32(warped[w, right + i]) - np.int32(warped[w, left + i])
        down = np.int32(reference[r_down, middle + i]) - np.int32(reference[r_up, middle + i])
        down -= np.int32(warped[w_down, middle + i]) - np.int32(warped[w_up, middle + i])
        total[i] = np.uint16(np.int32(total[i]) + abs(across) + abs(down))


@kernel
def sad_gradient_row(
    reference: U8, reference_row: int, warped: U8, warped_row: int, reach: int, pad: int, total: U16
) -> None:
    """Write the truncated differences of one row to `total`, (W,) uint16: of all colours, and of their gradients.

    Args:
        reference: (C, rows, W + 2 pad) uint8, wrapped.
        reference_row: its row.
        warped: likewise, the source.
        warped_row: its row.
        reach: columns from a pixel to those of its horizontal gradient.
        pad: width of the wrapped margin.
        total: written.
    """
    gradient = np.zeros(total.shape[0], np.uint16)
    total[:] = 0
    for c in range(reference.shape[0]):
        difference_row(reference[c], reference_row, warped[c], warped_row, pad, total)
        gradient_row(reference[c], reference_row, warped[c], warped_row, reach, pad, gradient)
    for i in range(_U(total.shape[0])):
        color = min(np.int32(total[i]), np.int32(MAX_COLOR_COST))
        total[i] = np.uint16(color + min(np.int32(gradient[i]), np.int32(MAX_GRADIENT_COST)))


@kernel
def census_gradient_row(
    reference: U8,
    reference_row: int,
    warped: U8,
    warped_row: int,
    offsets: I64,
    census_weight: int,
    pad: int,
    disagree: U8,
    total: U16,
) -> None:
    """Write the census cost of one row, its weight times, plus that of grey levels and of their gradients.

    Args:
        reference: (rows, W + 2 pad) uint8 grey, wrapped.
        reference_row: its row.
        warped: likewise, the source.
        warped_row: its row.
        offsets: (window,) int64 columns of the census window against its centre.
        census_weight: see `SweepSettings.census_weight`.
        pad: width of the wrapped margin.
        disagree: (W,) uint8, scratch.
        total: (W,) uint16, written.
    """
    count_census_row(reference, reference_row, warped, warped_row, offsets, pad, disagree)
    reach = offsets[offsets.shape[0] // 2 + 1]
    r, r_up, r_down = _U(reference_row), _U(reference_row - 1), _U(reference_row + 1)
    w, w_up, w_down = _U(warped_row), _U(warped_row - 1), _U(warped_row + 1)
    left, middle, right = _U(pad - reach), _U(pad), _U(pad + reach)
    for i in range(_U(total.shape[0])):  # everything in 16 bits, so that a register holds as many pixels as can be
        level = _step(reference[r, middle + i], warped[w, middle + i])
        across = _I(
            _step(reference[r, right + i], reference[r, left + i]) - _step(warped[w, right + i], warped[w, left + i])
        )
        down = _I(
            _step(reference[r_down, middle + i], reference[r_up, middle + i])
            - _step(warped[w_down, middle + i], warped[w_up, middle + i])
        )
        gradient = _I(max(across, _I(-across)) + max(down, _I(-down)))
        grey = _I(min(max(level, _I(-level)), _LARGEST_LEVEL) + min(gradient, _LARGEST_GRADIENT))
        census = np.uint16(np.uint16(census_weight) * np.uint16(disagree[i]))
        total[i] = np.uint16(census + np.uint16(np.uint16(GREY_WEIGHT) * np.uint16(grey)))


@inlined
def _step(a: np.uint8, b: np.uint8) -> np.int16:
    return _I(_I(a) - _I(b))
