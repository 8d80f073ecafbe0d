"""Compiled: averages of the planes of a volume of costs among neighbours with given weights."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_lookup import wrap_row
from pano_mvs.algorithms.sweep.numba.kernels_records import I64, U8, U16
from pano_mvs.core.kernels import kernel

_U = np.uint64
_H = np.uint16
_HALF = np.uint16(128)


@kernel
def _add_weighted(weights: U16, costs: U8, first: int, total: U16) -> None:
    """Add weights times costs, from `first` on, to the total, all of a row."""
    start = _U(first)
    for i in range(_U(total.shape[0])):
        total[i] = _H(total[i] + _H(weights[i] * _H(costs[start + i])))


@kernel
def _average_row(costs: U8, columns: I64, weights: U16, row: int, padded: U8, total: U16, result: U8) -> None:
    """Average a row, (W,), around the sphere along itself; `padded` and `total` are scratch."""
    width = costs.shape[0]
    margin = (padded.shape[0] - width) // 2
    for i in range(_U(width)):
        padded[_U(margin) + i] = costs[i]
    wrap_row(padded, width, margin)
    total[:] = _HALF
    for k in range(weights.shape[0]):
        _add_weighted(weights[k, row], padded, margin + columns[row, k], total)
    for i in range(_U(width)):
        result[i] = np.uint8(total[i] >> _H(8))


@kernel
def _row_beyond(rows: U8, row: int, at_pole: bool, result: U8) -> None:
    """Write the row that follows beyond the first or last one: half a turn further on beyond a pole, else the same."""
    width = _U(rows.shape[1])
    turn = width // _U(2) if at_pole else _U(0)
    for i in range(width - turn):
        result[i] = rows[row, turn + i]
    for i in range(turn):
        result[width - turn + i] = rows[row, i]


@kernel
def average_planes(
    volume: U8, first: int, count: int, columns: I64, along: U16, across: U16, at_poles: tuple[bool, bool]
) -> None:
    """Average some planes of a volume in place, along rows and then across them.

    `volume`: (rows, D, W) uint8. `first`: the first plane. `count`: how many. `columns`: (rows, side) int64, see
    `EdgeSupport`. `along`: (side, rows, W) uint16. `across`: (side, rows, W) uint16. `at_poles`: whether the first row
    is at a pole, and whether the last one is.
    """
    height, _, width = volume.shape
    side = along.shape[0]
    radius = side // 2
    margin = 1
    for y in range(columns.shape[0]):
        for k in range(columns.shape[1]):
            margin = max(margin, columns[y, k])
    padded, total = np.empty(width + 2 * margin, np.uint8), np.empty(width, np.uint16)
    rows = np.empty((height + 2 * radius, width), np.uint8)
    for d in range(first, first + count):
        for y in range(height):
            _average_row(volume[y, d], columns, along, y, padded, total, rows[radius + y])
        for step in range(radius):
            above = step if at_poles[0] else 0
            below = height - 1 - step if at_poles[1] else height - 1
            _row_beyond(rows, radius + min(above, height - 1), at_poles[0], rows[radius - 1 - step])
            _row_beyond(rows, radius + max(below, 0), at_poles[1], rows[radius + height + step])
        for y in range(height):
            total[:] = _HALF
            for k in range(side):
                _add_weighted(across[k, y], rows[y + k], 0, total)
            for i in range(_U(width)):
                volume[y, d, i] = np.uint8(total[i] >> _H(8))
