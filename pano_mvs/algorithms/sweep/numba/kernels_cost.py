"""Compiled: census and differences of one row, and means over boxes."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I32, I64, U8, U16
from pano_mvs.core.kernels import kernel

_F = np.float32
_U = np.uint64


@kernel
def census_row(
    reference: U8, reference_row: int, warped: U8, warped_row: int, offsets: I64, pad: int, disagree: U8
) -> None:
    """Count the neighbours whose order against the centre differs between reference and warped source.

    Args:
        reference: (rows, W + 2 pad) uint8 grey, wrapped.
        reference_row: row of the window's centre in `reference`.
        warped: likewise, the source.
        warped_row: row of the window's centre in `warped`.
        offsets: (window,) int64 columns of the window against its centre.
        pad: width of the wrapped margin.
        disagree: (W,) uint8, written.
    """
    side = offsets.shape[0]
    width = _U(disagree.shape[0])
    middle = _U(pad)
    r0, w0 = _U(reference_row), _U(warped_row)
    disagree[:] = 0
    for j in range(side):
        r, w = _U(reference_row + j - side // 2), _U(warped_row + j - side // 2)
        for k in range(side):
            if j == side // 2 and k == side // 2:
                continue
            first = _U(pad + offsets[k])
            for i in range(width):
                differs = (reference[r, first + i] > reference[r0, middle + i]) != (
                    warped[w, first + i] > warped[w0, middle + i]
                )
                disagree[i] = np.uint8(disagree[i] + np.uint8(differs))


@kernel
def difference_row(reference: U8, reference_row: int, warped: U8, warped_row: int, pad: int, total: U16) -> None:
    """Add |reference − warped| of one row of one colour to `total`, (W,) uint16."""
    r, w, first = _U(reference_row), _U(warped_row), _U(pad)
    for i in range(_U(total.shape[0])):
        difference = np.int16(np.int16(reference[r, first + i]) - np.int16(warped[w, first + i]))
        total[i] = np.uint16(total[i] + np.uint16(abs(difference)))


@kernel
def average_row(column_sums: I32, reach: int, pad: int, share: np.float32, scratch: I32, means: F32) -> None:
    """Write sums of 2 reach + 1 neighbouring columns, times `share`; see `box_rows`."""
    sums, first = column_sums, _U(pad - reach)
    second, third, fourth, fifth = first + _U(1), first + _U(2), first + _U(3), first + _U(4)
    if reach == 1:  # sums can be vectorised, and running sums cannot
        for i in range(_U(means.shape[0])):
            means[i] = _F(np.int32(sums[first + i] + sums[second + i] + sums[third + i])) * share
        return
    if reach == 2:
        for i in range(_U(means.shape[0])):
            inner = np.int32(sums[second + i] + sums[third + i] + sums[fourth + i])
            means[i] = _F(np.int32(sums[first + i] + inner + sums[fifth + i])) * share
        return
    if reach == 3:
        sixth, seventh = first + _U(5), first + _U(6)
        for i in range(_U(means.shape[0])):
            inner = np.int32(sums[third + i] + sums[fourth + i] + sums[fifth + i])
            inner = np.int32(inner + sums[second + i] + sums[sixth + i])
            means[i] = _F(np.int32(sums[first + i] + inner + sums[seventh + i])) * share
        return
    left, right = first, _U(pad + reach)
    running = np.int32(0)
    for i in range(_U(column_sums.shape[0])):
        running = np.int32(running + column_sums[i])
        scratch[i] = running
    for i in range(_U(means.shape[0])):
        means[i] = _F(np.int32(scratch[right + i] - scratch[left - _U(1) + i])) * share


@kernel
def box_rows(pixel_costs: U16, reach: I64, radius: int, pad: int, column_sums: I32, prefix: I32, means: F32) -> None:
    """Average costs over windows of 2 radius + 1 rows by 2 reach + 1 columns, in O(1) each.

    Args:
        pixel_costs: (rows + 2 radius, W + 2 pad) uint16, wrapped.
        reach: (rows,) int64 columns on either side, at most pad − 1, for each row.
        radius: rows on either side.
        pad: width of the wrapped margin.
        column_sums: (W + 2 pad,) int32, scratch.
        prefix: (W + 2 pad,) int32, scratch.
        means: (rows, W) float32, written.
    """
    rows = means.shape[0]
    padded = _U(pixel_costs.shape[1])
    if radius == 1:
        for y in range(rows):
            above, here, below = _U(y), _U(y + 1), _U(y + 2)
            for i in range(padded):
                outer = np.int32(np.int32(pixel_costs[above, i]) + np.int32(pixel_costs[below, i]))
                column_sums[i] = np.int32(outer + np.int32(pixel_costs[here, i]))
            average_row(column_sums, reach[y], pad, _F(1.0 / (3 * (2 * reach[y] + 1))), prefix, means[y])
        return
    column_sums[:] = 0
    for j in range(2 * radius):
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] + np.int32(pixel_costs[_U(j), i]))
    for y in range(rows):
        entering, leaving = _U(y + 2 * radius), _U(y)
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] + np.int32(pixel_costs[entering, i]))
        share = _F(1.0 / ((2 * radius + 1) * (2 * reach[y] + 1)))
        average_row(column_sums, reach[y], pad, share, prefix, means[y])
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] - np.int32(pixel_costs[leaving, i]))
