"""Compiled: semi-global matching along the rows, around the sphere in both directions.

A path goes around once before it counts, so that what it carries does not depend on where the columns start. The
second time, it is followed only until it carries what it did the first time: from there on nothing changes.
"""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_records import U8, U16
from pano_mvs.algorithms.sweep.numba.kernels_sgm import OUTSIDE
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector_path import LINES, SIDE, step_planes, turn_bytes, turn_sums
from pano_mvs.core.kernels import kernel

_U = np.uint64
_H = np.uint16
_BLOCK = 32  # columns of which all planes fit the nearest cache
_COMPARED = 8  # after how many pixels it is tried whether a path carries what it did before


@kernel
def _turn_row(volume: U8, y: int, costs: U8) -> None:
    """Write row y of a volume, (H, D, W), pixel by pixel, into (W, P)."""
    _, depth, width = volume.shape
    if HAS_VECTOR:
        if depth >= SIDE and width >= SIDE:
            padded = costs.shape[1]
            for first in range(0, depth, SIDE):
                d = min(first, depth - SIDE)
                for column in range(0, width, SIDE):
                    x = min(column, width - SIDE)
                    source = _U((y * depth + d) * width + x)
                    turn_bytes(volume, source, _U(0), _U(width), costs, _U(x * padded + d), _U(padded))
            return
    row = _U(y)
    for start in range(0, width, _BLOCK):
        stop = min(start + _BLOCK, width)
        for d in range(_U(depth)):
            for x in range(_U(start), _U(stop)):
                costs[x, d] = volume[row, d, x]


@kernel
def _turn_sums(paths: U16, sums: U16, y: int) -> None:
    """Write the sum of both directions, (2, W + 2, P), into row y of (·, D, W or more)."""
    depth, step = sums.shape[1:]
    width, padded = paths.shape[1] - 2, paths.shape[2]
    if HAS_VECTOR:
        if depth >= SIDE and width >= SIDE:
            for start in range(0, width, 2 * SIDE):  # what the nearest cache holds of `sums` at a time is complete
                for first in range(0, depth, SIDE):
                    d = min(first, depth - SIDE)
                    for column in range(start, min(start + 2 * SIDE, width), SIDE):
                        x = min(column, width - SIDE)
                        source, apart = _U(x * padded + d), _U(paths.shape[1] * padded)
                        turn_sums(paths, source, apart, _U(padded), sums, _U((y * depth + d) * step + x), _U(step))
            return
    row = _U(y)
    for start in range(0, width, _BLOCK):
        stop = min(start + _BLOCK, width)
        for d in range(_U(depth)):
            for x in range(_U(start), _U(stop)):
                sums[row, d, x] = _H(paths[0, x, d] + paths[1, x, d])


@kernel
def step_pixel(
    costs: U8,
    paths: U16,
    way: int,
    before: int,
    now: int,
    penalty: np.uint16,
    floor: np.uint16,
    p1: np.uint16,
    barred: U16,
    scratch: U16,
) -> np.uint16:
    """Advance a path by one pixel and return the least of its costs.

    `costs`: (W, P) uint8, P the number of planes D and some more to fill registers. `paths`: (2, W + 2, P) uint16 costs
    of the paths of both directions, written; pixel W is where they start, and the one after it is there because
    registers are read ahead. `way`: 0 or 1, the direction. `before`: the pixel before, or W. `now`: the pixel.
    `penalty`: P2 of the step. `floor`: the least cost of the pixel before. `p1`: uint16. `barred`: (P,) uint16, 0 for
    planes and `OUTSIDE` for what only fills registers. `scratch`: (2, D + 2) uint16, for each direction the costs in
    the pixel before, between two planes that do not exist; written; not used by vector instructions.
    """
    jump = _H(floor + penalty)
    if HAS_VECTOR:
        padded = paths.shape[2]
        start, registers = way * paths.shape[1], _U(padded // LINES)
        before_at, now_at = _U((start + before) * padded), _U((start + now) * padded)
        reached: np.uint16 = step_planes(
            costs, _U(now * padded), paths, before_at, now_at, registers, barred, jump, floor, p1
        )
        return reached
    direction, pixel, depth = _U(way), _U(now), _U(scratch.shape[1] - 2)
    for d in range(depth):
        stay = scratch[direction, d + _U(1)]
        down, up = _H(scratch[direction, d] + p1), _H(scratch[direction, d + _U(2)] + p1)
        near = down if down < up else up
        near = near if near < jump else jump
        near = stay if stay < near else near
        paths[direction, pixel, d] = _H(_H(near - floor) + _H(costs[pixel, d]))
    least = OUTSIDE
    for d in range(depth):
        value = paths[direction, pixel, d]
        least = value if value < least else least
        scratch[direction, d + _U(1)] = value
    return least


@kernel
def _close_circle(
    costs: U8,
    paths: U16,
    way: int,
    penalties: U16,
    floor: np.uint16,
    p1: np.uint16,
    barred: U16,
    scratch: U16,
    earlier: U16,
) -> None:
    """Follow a path, which has gone around once, again until it carries what it did then; `earlier`: (P,)."""
    width = costs.shape[0]
    before = 0 if way == 1 else width - 1
    for i in range(width):
        now = width - 1 - i if way == 1 else i
        compared = i % _COMPARED == _COMPARED - 1
        if compared:
            for d in range(_U(len(earlier))):
                earlier[d] = paths[_U(way), _U(now), d]
        floor = step_pixel(costs, paths, way, before, now, penalties[now], floor, p1, barred, scratch)
        if compared:
            different = 0
            for d in range(_U(len(earlier))):
                different += paths[_U(way), _U(now), d] != earlier[d]
            if different == 0:
                return
        before = now


@kernel
def follow_rows(volume: U8, penalties: U16, p1: np.uint16, rows: tuple[int, int], sums: U16, first_sums: int) -> None:
    """Follow both paths of some rows around the sphere and write the sum of their costs.

    `volume`: (H, D, W) uint8. `penalties`: (2, H, W) uint16 P2 of the step into each pixel from its left and from its
    right. `p1`: uint16. `rows`: the first row, and how many. `sums`: (·, D, ·) uint16, written; rows may be longer than
    the volume's. `first_sums`: the row with which `sums` begins.
    """
    depth, width = volume.shape[1:]
    padded = -(-depth // LINES) * LINES
    costs = np.zeros((width, padded), np.uint8)
    paths = np.zeros((2, width + 2, padded), np.uint16)
    barred, earlier = np.zeros(padded, np.uint16), np.empty(padded, np.uint16)
    barred[depth:] = OUTSIDE
    scratch = np.full((2, depth + 2), OUTSIDE, np.uint16)
    for y in range(rows[0], rows[0] + rows[1]):
        _turn_row(volume, y, costs)
        for d in range(_U(padded)):
            paths[0, width, d] = paths[1, width, d] = barred[d]
        scratch[:, 1 : depth + 1] = 0
        right, left = penalties[0, y], penalties[1, y]
        floor_right, floor_left = _H(0), _H(0)
        for i in range(width):
            x = width - 1 - i
            before = i - 1 if i > 0 else width
            floor_right = step_pixel(costs, paths, 0, before, i, right[i], floor_right, p1, barred, scratch)
            before = x + 1
            floor_left = step_pixel(costs, paths, 1, before, x, left[x], floor_left, p1, barred, scratch)
        _close_circle(costs, paths, 0, right, floor_right, p1, barred, scratch, earlier)
        _close_circle(costs, paths, 1, left, floor_left, p1, barred, scratch, earlier)
        _turn_sums(paths, sums, y - first_sums)
