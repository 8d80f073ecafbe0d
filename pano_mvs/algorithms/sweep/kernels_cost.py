"""Compiled: the cost of a band of rows at one virtual range."""

from __future__ import annotations

import numpy as np
from numba import njit

_F = np.float32
_U = np.uint64


@njit(cache=True, error_model="numpy", nogil=True)
def census_row(reference, reference_row, warped, warped_row, offsets, pad, disagree):  # type: ignore[no-untyped-def]
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


@njit(cache=True, error_model="numpy", nogil=True)
def difference_row(reference, reference_row, warped, warped_row, pad, total):  # type: ignore[no-untyped-def]
    """Add |reference − warped| of one row of one colour to `total`, (W,) uint16."""
    r, w, first = _U(reference_row), _U(warped_row), _U(pad)
    for i in range(_U(total.shape[0])):
        difference = np.int16(np.int16(reference[r, first + i]) - np.int16(warped[w, first + i]))
        total[i] = np.uint16(total[i] + np.uint16(abs(difference)))


@njit(cache=True, error_model="numpy", nogil=True)
def box_rows(pixel_costs, reach, radius, pad, column_sums, prefix, means):  # type: ignore[no-untyped-def]
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
    rows, width = means.shape
    padded = _U(pixel_costs.shape[1])
    column_sums[:] = 0
    for j in range(2 * radius):
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] + np.int32(pixel_costs[_U(j), i]))
    for y in range(rows):
        entering, leaving = _U(y + 2 * radius), _U(y)
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] + np.int32(pixel_costs[entering, i]))
        running = np.int32(0)
        for i in range(padded):
            running = np.int32(running + column_sums[i])
            prefix[i] = running
        left, right = _U(pad - reach[y] - 1), _U(pad + reach[y])
        share = _F(1.0 / ((2 * radius + 1) * (2 * reach[y] + 1)))
        row = _U(y)
        for i in range(_U(width)):
            means[row, i] = _F(np.int32(prefix[right + i] - prefix[left + i])) * share
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] - np.int32(pixel_costs[leaving, i]))


@njit(cache=True, error_model="numpy", nogil=True)
def combine_row(costs, y, best_half, all_vote, neutral, result):  # type: ignore[no-untyped-def]
    """Combine the sources' costs of one row, infinite where a source has no vote.

    Args:
        costs: (S, rows, W) float32; sorted in place if only the better half counts.
        y: the row.
        best_half: average the better half of the voting sources (rounded up), else all of them.
        all_vote: that no cost is infinite.
        neutral: the cost where no source has a vote.
        result: (W,) float32, written.
    """
    sources = costs.shape[0]
    row = _U(y)
    if best_half:
        for last in range(sources - 1, 0, -1):
            for k in range(last):
                a, b = _U(k), _U(k + 1)
                for i in range(_U(result.shape[0])):
                    p, q = costs[a, row, i], costs[b, row, i]
                    costs[a, row, i] = p if p < q else q
                    costs[b, row, i] = q if p < q else p
    if all_vote:
        _mean_of_first(costs, row, (sources + 1) // 2 if best_half else sources, result)
        return
    for i in range(_U(result.shape[0])):
        votes = 0
        for k in range(sources):
            votes += costs[_U(k), row, i] < np.inf
        used = (votes + 1) // 2 if best_half else votes
        total = _F(0)
        taken = 0
        for k in range(sources):
            cost = costs[_U(k), row, i]
            if cost < np.inf and taken < used:
                total += cost
                taken += 1
        result[i] = total / _F(used) if used else neutral


@njit(cache=True, error_model="numpy", nogil=True)
def _mean_of_first(costs, row, used, result):  # type: ignore[no-untyped-def]
    result[:] = _F(0)
    for k in range(used):
        for i in range(_U(result.shape[0])):
            result[i] += costs[_U(k), row, i]
    for i in range(_U(result.shape[0])):
        result[i] /= _F(used)
