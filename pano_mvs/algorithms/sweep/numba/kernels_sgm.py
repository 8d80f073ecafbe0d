"""Compiled: semi-global matching on the sphere, one path direction and one strip or row at a time.

H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", TPAMI 2008, equation 13:
L(p, d) = C(p, d) + min(L(q, d), L(q, d ± 1) + P1, min L(q) + P2) − min L(q), q the pixel before p on the path.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pano_mvs.algorithms.sweep.numba.kernels_records import U8, U16
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector_path import LINES, step_lines

_U = np.uint64
_H = np.uint16
_OUTSIDE = np.uint16(60000)  # the cost of the planes before the first and after the last; P1 on top must not overflow
_BLOCK = 32  # columns of which all planes fit the nearest cache


@njit(cache=True, error_model="numpy", nogil=True)
def step_plain(
    volume: U8,
    total: U16,
    place: tuple[int, int],
    segment: tuple[int, int],
    penalties: U16,
    p1: np.uint16,
    before: U16,
    least_before: U16,
    after: U16,
    least: U16,
    keep: bool,
) -> None:
    """Advance the lines of one segment by one row: `place` (row, column), `segment` (first line, lines)."""
    row, column = _U(place[0]), _U(place[1])
    first, lines = _U(segment[0]), _U(segment[1])
    for d in range(_U(volume.shape[1])):
        for k in range(lines):
            line = first + k
            floor = least_before[line]
            stay = before[d + _U(1), line]
            down, up = _H(before[d, line] + p1), _H(before[d + _U(2), line] + p1)
            near = down if down < up else up
            jump = _H(floor + penalties[row, column + k])
            near = near if near < jump else jump
            near = stay if stay < near else near
            value = _H(_H(near - floor) + _H(volume[row, d, column + k]))
            after[d + _U(1), line] = value
            least[line] = value if value < least[line] else least[line]
        if keep:
            for k in range(lines):
                total[row, d, column + k] = _H(total[row, d, column + k] + after[d + _U(1), first + k])


@njit(cache=True, error_model="numpy", nogil=True)
def step_segment(
    volume: U8,
    total: U16,
    place: tuple[int, int],
    segment: tuple[int, int],
    penalties: U16,
    p1: np.uint16,
    state: U16,
    least: U16,
    keep: bool,
) -> None:
    """Do what `step_plain` does by vector instructions, in place; volume and total must be contiguous.

    Lines have a margin of `LINES` on either side: where the row ends before a register does, it starts earlier, with
    lines of no meaning that are left as they are.
    """
    _, depth, width = volume.shape
    first, lines = segment
    for done in range(0, lines, LINES):
        back = max(0, place[1] + done + LINES - width)
        column = place[1] + done - back
        counted = _U(back), _U(back + min(LINES, lines - done))
        step_lines(
            volume,
            total,
            (_U(place[0] * depth * width + column), _U(width), _U(depth)),
            p1,
            penalties,
            _U(place[0] * width + column),
            state,
            least,
            (_U(LINES + first + done - back), _U(state.shape[1]), counted[0], counted[1]),
            _U(keep),
        )


@njit(cache=True, error_model="numpy", nogil=True)
def sweep_strip(
    volume: U8, total: U16, penalties: U16, p1: np.uint16, first: int, lines: int, drift: int, upward: bool, warm: int
) -> None:
    """Follow one strip of parallel paths from pole to pole and add their costs to the total.

    Line k is at column first + k + drift·i in step i. Steps i < 0 lie beyond the pole from which the paths come:
    in row −1 − i, half a turn further on; their costs only prepare the state.

    Args:
        volume: (H, D, W) uint8.
        total: (H, D, W) uint16, added to; strips of one direction touch disjoint entries.
        penalties: (H, W) uint16 P2 of the step into each pixel.
        p1: uint16.
        first: column of the first line in row 0 (row H − 1 for upward paths).
        lines: number of lines.
        drift: columns by which a path moves in each step: −1, 0 or 1.
        upward: whether the paths run from the last row to the first.
        warm: steps before the pole.
    """
    height, depth, width = volume.shape
    vector = HAS_VECTOR and width >= LINES
    margin = LINES if vector else 0
    buffers = np.zeros((1 if vector else 2, depth + 2, lines + 2 * margin), np.uint16)
    buffers[:, 0, :] = _OUTSIDE
    buffers[:, depth + 1, :] = _OUTSIDE
    least = np.zeros((2, lines + 2 * margin), np.uint16)
    for i in range(-warm, height):
        now = (i + warm) % 2
        row = i if i >= 0 else -1 - i
        row = height - 1 - row if upward else row
        column = first + drift * i + (0 if i >= 0 else width // 2)
        column = (column % width + width) % width
        direct = min(lines, width - column)
        if HAS_VECTOR:  # a constant: without it step_segment is not compiled, which is impossible on other processors
            if vector:
                step_segment(volume, total, (row, column), (0, direct), penalties, p1, buffers[0, 1:], least[0], i >= 0)
                step_segment(
                    volume, total, (row, 0), (direct, lines - direct), penalties, p1, buffers[0, 1:], least[0], i >= 0
                )
                continue
        least[now, :] = _OUTSIDE
        for place, segment in (((row, column), (0, direct)), ((row, 0), (direct, lines - direct))):
            step_plain(
                volume,
                total,
                place,
                segment,
                penalties,
                p1,
                buffers[1 - now],
                least[1 - now],
                buffers[now],
                least[now],
                i >= 0,
            )


@njit(cache=True, error_model="numpy", nogil=True)
def _turn_row(volume: U8, y: int, costs: U8) -> None:
    """Write row y of a volume, (H, D, W), pixel by pixel, into (W, D)."""
    row, width = _U(y), volume.shape[2]
    for start in range(0, width, _BLOCK):
        stop = min(start + _BLOCK, width)
        for d in range(_U(volume.shape[1])):
            for x in range(_U(start), _U(stop)):
                costs[x, d] = volume[row, d, x]


@njit(cache=True, error_model="numpy", nogil=True)
def _add_turned_row(sums: U16, y: int, total: U16) -> None:
    """Add (W, D) to row y of (H, D, W)."""
    row, width = _U(y), total.shape[2]
    for start in range(0, width, _BLOCK):
        stop = min(start + _BLOCK, width)
        for d in range(_U(total.shape[1])):
            for x in range(_U(start), _U(stop)):
                total[row, d, x] = _H(total[row, d, x] + sums[x, d])


@njit(cache=True, error_model="numpy", nogil=True)
def _circle(costs: U8, penalties: U16, p1: np.uint16, direction: int, warm: int, sums: U16) -> None:
    """Follow one horizontal path and add its costs to `sums`, (W, D) uint16; `penalties` is (W,).

    The loops are in this function, and not in one for each pixel: views of arrays take longer than a pixel's planes.
    """
    width, depth = costs.shape
    before, after = np.full(depth + 2, _OUTSIDE, np.uint16), np.full(depth + 2, _OUTSIDE, np.uint16)
    before[1 : depth + 1] = 0
    floor = _H(0)
    for i in range(-warm, width):
        x = (i + warm * width) % width
        pixel = _U(width - 1 - x if direction == 1 else x)
        jump = _H(floor + penalties[pixel])
        for d in range(_U(depth)):
            stay = before[d + _U(1)]
            down, up = _H(before[d] + p1), _H(before[d + _U(2)] + p1)
            near = down if down < up else up
            near = near if near < jump else jump
            near = stay if stay < near else near
            after[d + _U(1)] = _H(_H(near - floor) + _H(costs[pixel, d]))
        floor = _OUTSIDE
        for d in range(_U(depth)):
            value = after[d + _U(1)]
            floor = value if value < floor else floor
            before[d + _U(1)] = value
        if i >= 0:
            for d in range(_U(depth)):
                sums[pixel, d] = _H(sums[pixel, d] + before[d + _U(1)])


@njit(cache=True, error_model="numpy", nogil=True)
def sweep_row(volume: U8, total: U16, penalties: U16, p1: np.uint16, y: int, warm: int) -> None:
    """Follow both horizontal paths of one row around the sphere and add their costs to the total.

    Args:
        volume: (H, D, W) uint8.
        total: (H, D, W) uint16, added to.
        penalties: (2, H, W) uint16 P2 of the step into each pixel from its left and from its right.
        p1: uint16.
        y: the row.
        warm: steps before the seam, which only prepare the state.
    """
    depth, width = volume.shape[1:]
    costs = np.empty((width, depth), np.uint8)
    sums = np.zeros((width, depth), np.uint16)
    _turn_row(volume, y, costs)
    for direction in range(2):
        _circle(costs, penalties[direction, y], p1, direction, warm, sums)
    _add_turned_row(sums, y, total)
