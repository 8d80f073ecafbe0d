"""Compiled: winner takes all, some planes at a time, without a cost volume."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.kernels_records import U16
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR, REGISTER_BYTES
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector_winner import (
    AFTER,
    BEFORE,
    BEST,
    EARLIER,
    LAST,
    LAST_BUT_ONE,
    RIVAL,
    STATES,
    take_planes,
)
from pano_mvs.core.kernels import kernel

__all__ = [
    "AFTER",
    "BEFORE",
    "BEST",
    "PLANES_AT_ONCE",
    "RIVAL",
    "STATES",
    "update_plain",
    "update_winners",
    "winners_of_rows",
]

_U = np.uint64

PLANES_AT_ONCE = 8
"""After how many planes the running state, larger than a band's costs, is best brought up to date."""


@kernel
def update_plain(
    costs: NDArray[Any],
    start: int,
    count: int,
    plane: int,
    state: NDArray[Any],
    y: int,
    planes: NDArray[Any],
    begin: int,
) -> None:
    """Take in the costs of some planes for one row.

    `EARLIER` is the least cost of all planes but the last two: when a plane wins, it is the rival so far.

    `costs`: (P, W) float32 or uint16. `start`: the first plane's place in `costs`. `count`: of planes. `plane`: index
    of the first plane; they come in order. `state`: (STATES, rows, W) of the costs' type, infinite or its largest
    number before the first plane. `y`: the row. `planes`: (rows, W) int32, or uint16 for costs in uint16: index of the
    winner so far. `begin`: the first column; all from there on are treated.
    """
    row = _U(y)
    for k in range(count):
        here, now = _U(start + k), np.int32(plane + k)
        for i in range(_U(begin), _U(costs.shape[1])):
            cost = costs[here, i]
            best = state[BEST, row, i]
            last, last_but_one = state[LAST, row, i], state[LAST_BUT_ONE, row, i]
            earlier = state[EARLIER, row, i]
            earlier = last_but_one if last_but_one < earlier else earlier
            rival = state[RIVAL, row, i]
            nearer_rival = cost if cost < rival else rival
            winner = np.int32(planes[row, i])
            gap = np.int32(now - winner)
            wins = cost < best
            kept_rival = nearer_rival if gap > np.int32(1) else rival
            kept_after = cost if gap == np.int32(1) else state[AFTER, row, i]
            state[RIVAL, row, i] = earlier if wins else kept_rival
            state[AFTER, row, i] = cost if wins else kept_after
            state[BEFORE, row, i] = last if wins else state[BEFORE, row, i]
            state[BEST, row, i] = cost if wins else best
            planes[row, i] = now if wins else winner
            state[LAST_BUT_ONE, row, i] = last
            state[LAST, row, i] = cost
            state[EARLIER, row, i] = earlier


@kernel
def update_winners(
    costs: NDArray[Any], start: int, count: int, plane: int, state: NDArray[Any], y: int, planes: NDArray[Any]
) -> None:
    """Do what `update_plain` does, by vector instructions where there are any; costs and state must be contiguous."""
    width, rows = costs.shape[1], state.shape[1]
    whole = 0
    if HAS_VECTOR:
        pixels = REGISTER_BYTES // planes.itemsize
        whole = width - width % pixels
        for i in range(0, whole, pixels):
            take_planes(
                costs,
                _U(start * width + i),
                _U(width),
                _U(plane),
                _U(count),
                state,
                _U(y * width + i),
                _U(rows * width),
                planes,
                _U(y * width + i),
            )
    update_plain(costs, start, count, plane, state, y, planes, whole)


@kernel
def winners_of_rows(total: U16, first: int, state: U16, planes: U16) -> None:
    """Find the winners of some rows of a volume.

    `total`: (H, D, W) uint16. `first`: the first row. `state`: (STATES, rows, W) uint16, the largest number. `planes`:
    (rows, W) uint16, written.
    """
    depth = total.shape[1]
    for y in range(planes.shape[0]):
        for d in range(0, depth, PLANES_AT_ONCE):
            update_winners(total[first + y], d, min(PLANES_AT_ONCE, depth - d), d, state, y, planes)
