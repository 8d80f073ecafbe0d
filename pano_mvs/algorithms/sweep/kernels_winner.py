"""Compiled: winner takes all, one plane at a time, so that no volume is needed."""

from __future__ import annotations

import numpy as np
from numba import njit

_U = np.uint64

# The rows of the running state, float32.
BEST, BEFORE, AFTER, RIVAL, LAST, LAST_BUT_ONE, EARLIER = range(7)
STATES = 7


@njit(cache=True, error_model="numpy", nogil=True)
def update_winner(costs, plane, state, y, planes):  # type: ignore[no-untyped-def]
    """Take in the costs of the next plane for one row.

    `EARLIER` is the least cost of all planes but the last two: when a plane wins, it is the rival so far.

    Args:
        costs: (W,) float32.
        plane: index of the plane; they come in order.
        state: (STATES, rows, W) float32, infinite before the first plane.
        y: the row.
        planes: (rows, W) int32 index of the winner so far.
    """
    row = _U(y)
    now = np.int32(plane)
    for i in range(_U(costs.shape[0])):
        cost = costs[i]
        best = state[BEST, row, i]
        last, last_but_one = state[LAST, row, i], state[LAST_BUT_ONE, row, i]
        earlier = state[EARLIER, row, i]
        earlier = last_but_one if last_but_one < earlier else earlier
        rival = state[RIVAL, row, i]
        nearer_rival = cost if cost < rival else rival
        gap = np.int32(now - planes[row, i])
        wins = cost < best
        kept_rival = nearer_rival if gap > np.int32(1) else rival
        kept_after = cost if gap == np.int32(1) else state[AFTER, row, i]
        state[RIVAL, row, i] = earlier if wins else kept_rival
        state[AFTER, row, i] = cost if wins else kept_after
        state[BEFORE, row, i] = last if wins else state[BEFORE, row, i]
        state[BEST, row, i] = cost if wins else best
        planes[row, i] = now if wins else planes[row, i]
        state[LAST_BUT_ONE, row, i] = last
        state[LAST, row, i] = cost
        state[EARLIER, row, i] = earlier


@njit(cache=True, error_model="numpy", nogil=True)
def winners_of_rows(total, first, state, planes):  # type: ignore[no-untyped-def]
    """Find the winners of some rows of a volume.

    Args:
        total: (H, D, W) uint16.
        first: the first row.
        state: (STATES, rows, W) float32, infinite.
        planes: (rows, W) int32, written.
    """
    depth, width = total.shape[1:]
    costs = np.empty(width, np.float32)
    for y in range(planes.shape[0]):
        source_row = _U(first + y)
        for d in range(depth):
            for i in range(_U(width)):
                costs[i] = np.float32(total[source_row, _U(d), i])
            update_winner(costs, d, state, y, planes)
