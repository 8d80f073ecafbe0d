"""Compiled: semi-global matching on the sphere, three path directions from pole to pole at a time, block by block.

H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", TPAMI 2008, equation 13:
L(p, d) = C(p, d) + min(L(q, d), L(q, d ± 1) + P1, min L(q) + P2) − min L(q), q the pixel before p on the path.

The straight and the two diagonal paths that come to a pixel from one pole advance together, so that costs and sums are
read once. Where a strip of columns begins and ends, diagonal paths come from beyond it: for a block of rows, a strip
starts with as many more columns on either side and loses one with each row.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_records import I64, U8, U16
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector_path import LINES, step_lines
from pano_mvs.core.kernels import kernel

_U = np.uint64
_H = np.uint16
OUTSIDE = np.uint16(60000)  # the cost of the planes before the first and after the last; P1 on top must not overflow
_ALL = -1

DRIFTS = (0, 1, -1)
"""Columns by which the paths of each direction move in a step."""


@kernel
def look_up_penalties(channels: U8, table: U16, steps: I64, first: int, penalties: U16) -> None:
    """Do what `penalties.step_penalties` does for several directions.

    `channels`: (C, H + 2, W + 2) uint8, see `padded_channels`. `table`: see `penalty_table`. `steps`: (K, 2) int64 rows
    and columns of each direction. `first`: the first row. `penalties`: (K, rows, W) uint16, written.
    """
    contrast = np.empty(penalties.shape[2], np.uint8)
    for k in range(_U(penalties.shape[0])):
        for y in range(_U(penalties.shape[1])):
            here = _U(first + 1) + y
            before = _U(first + 1 - steps[k, 0]) + y
            shift = _U(1 - steps[k, 1])
            contrast[:] = 0
            for c in range(_U(channels.shape[0])):
                for x in range(_U(penalties.shape[2])):
                    a, b = channels[c, here, x + _U(1)], channels[c, before, x + shift]
                    step = np.uint8(a - b) if a > b else np.uint8(b - a)
                    contrast[x] = step if step > contrast[x] else contrast[x]
            for x in range(_U(penalties.shape[2])):
                penalties[k, y, x] = table[_U(contrast[x])]


class PathCosts(NamedTuple):
    """What paths from one pole to the other read.

    `volume`: (H, D, W) uint8. `penalties`: (3, H, W) uint16 P2 of the step into each pixel, for each of `DRIFTS`. `p1`:
    uint16. `upward`: whether the paths run from the last row to the first.
    """

    volume: U8
    penalties: U16
    p1: np.uint16
    upward: bool


class Front(NamedTuple):
    """Where paths have come to.

    `paths`: (3, D, W) uint16 costs of the paths in the last pixels that they came to, by the columns of these. `least`:
    (3, W) uint16 the least of each.
    """

    paths: U16
    least: U16


class Sums(NamedTuple):
    """Where sums of path costs are read and written.

    `before`: (·, D, ·) uint16 sums of other paths; rows may be longer than the volume's. `first_before`: the row of the
    picture with which `before` begins. `after`: (·, D, ·) uint16, written: with those of these paths; the same length
    of rows. `first_after`: the row with which `after` begins.
    """

    before: U16
    first_before: int
    after: U16
    first_after: int


@kernel
def step_plain(
    costs: PathCosts,
    place: tuple[int, int],
    lines: int,
    direction: int,
    line: int,
    state: U16,
    least: U16,
    scratch: U16,
    sums: Sums,
    others: bool,
    keep: bool,
) -> None:
    """Advance neighbouring lines of one direction by one row.

    `costs`: what paths read. `place`: row and column of the first line's pixel; the others follow in the row. `lines`:
    number of lines. `direction`: among `DRIFTS`. `line`: the first line's place in the state. `state`: (3, D + 1, ·)
    uint16 costs of the paths, updated. `least`: (3, ·) uint16 the least of each, updated. `scratch`: (2, ·) uint16.
    `sums`: where to write sums. `others`: whether these lines are added to `sums.before`, or to those that were added
    to them already. `keep`: whether to write sums.
    """
    volume, p1 = costs.volume, costs.p1
    row, column, first, way = _U(place[0]), _U(place[1]), _U(line), _U(direction)
    row_before, row_after = _U(place[0] - sums.first_before), _U(place[0] - sums.first_after)
    for k in range(_U(lines)):
        scratch[0, k], scratch[1, k] = OUTSIDE, OUTSIDE
    for d in range(_U(volume.shape[1])):
        for k in range(_U(lines)):
            floor = least[way, first + k]
            stay = state[way, d, first + k]
            down, up = _H(scratch[0, k] + p1), _H(state[way, d + _U(1), first + k] + p1)
            near = down if down < up else up
            jump = _H(floor + costs.penalties[way, row, column + k])
            near = near if near < jump else jump
            near = stay if stay < near else near
            value = _H(_H(near - floor) + _H(volume[row, d, column + k]))
            scratch[0, k] = stay
            scratch[1, k] = value if value < scratch[1, k] else scratch[1, k]
            state[way, d, first + k] = value
        if keep and others:
            for k in range(_U(lines)):
                sums.after[row_after, d, column + k] = _H(
                    sums.before[row_before, d, column + k] + state[way, d, first + k]
                )
        elif keep:
            for k in range(_U(lines)):
                sums.after[row_after, d, column + k] = _H(
                    sums.after[row_after, d, column + k] + state[way, d, first + k]
                )
    for k in range(_U(lines)):
        least[way, first + k] = scratch[1, k]


@kernel
def _step_vector(
    costs: PathCosts,
    place: tuple[int, int],
    lines: int,
    direction: int,
    line: tuple[int, int, int],
    state: U16,
    least: U16,
    sums: Sums,
    keep: bool,
) -> None:
    """Advance neighbouring lines of all directions, or of one, by one row.

    Lines have a margin of `LINES` on either side: where the row ends before a register does, it starts earlier, with
    lines of no meaning that are left as they are.
    """
    volume, p1, penalties = costs.volume, costs.p1, costs.penalties
    height, depth, width = volume.shape
    planes, stride = state.shape[1:]
    sum_step = sums.after.shape[2]
    row = place[0]
    row_before, row_after = row - sums.first_before if keep else 0, row - sums.first_after if keep else 0
    for done in range(0, lines, LINES):
        back = max(0, place[1] + done + LINES - width)
        column, first = place[1] + done - back, done - back
        places = row * depth * width, row_before * depth * sum_step, row_after * depth * sum_step
        voxels = (
            *(_U(places[0] + column), _U(places[1] + column), _U(places[2] + column)),
            *(_U(width), _U(sum_step), _U(depth)),
        )
        counted = _U(stride), _U(back), _U(back + min(LINES, lines - done)), _U(keep)
        if direction == _ALL:
            pixel, lower = row * width + column, planes * stride
            pixels = _U(pixel), _U(pixel + height * width), _U(pixel + 2 * height * width)
            at = (
                *(_U(line[0] + first), _U(line[0] + first)),
                *(_U(lower + line[1] + first), _U(stride + line[1] + first)),
                *(_U(2 * lower + line[2] + first), _U(2 * stride + line[2] + first)),
            )
            step_lines(volume, voxels, p1, penalties, pixels, state, least, at, counted, sums.before, sums.after)
        else:
            start = line[direction] + first
            one_pixel = (_U((direction * height + row) * width + column),)
            one_at = _U(direction * planes * stride + start), _U(direction * stride + start)
            step_lines(volume, voxels, p1, penalties, one_pixel, state, least, one_at, counted, sums.before, sums.after)


@kernel
def _step_row(
    costs: PathCosts,
    row: int,
    columns: tuple[int, int],
    direction: int,
    line: tuple[int, int, int],
    state: U16,
    least: U16,
    scratch: U16,
    sums: Sums,
    keep: bool,
) -> None:
    """Advance the lines that come to some columns, (first, how many), which may pass the seam, by one row."""
    width = costs.volume.shape[2]
    done = 0
    while done < columns[1]:
        column = (columns[0] + done) % width
        lines = min(columns[1] - done, width - column)
        place, start = (row, column), (line[0] + done, line[1] + done, line[2] + done)
        vector = False
        if HAS_VECTOR:  # a constant: without it `step_lines` is not compiled, which is impossible on other processors
            vector = width >= LINES
            if vector:
                _step_vector(costs, place, lines, direction, start, state, least, sums, keep)
        if not vector:
            for way in range(3):
                if direction in (_ALL, way):
                    step_plain(costs, place, lines, way, start[way], state, least, scratch, sums, way == 0, keep)
        done += lines


@kernel
def _take_front(front: Front, column: int, lines: int, state: U16, least: U16) -> None:
    """Copy where the paths have come to in some columns, which may go around the seam several times."""
    depth, width = front.paths.shape[1:]
    for way in range(3):
        done = 0
        while done < lines:
            start = (column + done) % width
            count = min(lines - done, width - start)
            to, source = _U(LINES + done), _U(start)
            for k in range(_U(count)):
                least[way, to + k] = front.least[way, source + k]
            for d in range(depth):
                for k in range(_U(count)):
                    state[way, d, to + k] = front.paths[way, d, source + k]
            done += count


def state_columns(strip: int, steps: int) -> int:
    """Return how many columns of scratch space `follow_block` needs for a strip of columns and some steps."""
    return strip + 2 * steps + 2 * LINES


@kernel
def follow_block(
    costs: PathCosts,
    front: Front,
    new_front: Front,
    steps: tuple[int, int],
    strip: tuple[int, int],
    sums: Sums,
    state: U16,
) -> None:
    """Follow the paths that come to a strip of columns through a block of rows and add their costs to the sums.

    Step i comes to the row i, counted from where the paths begin. Steps i < 0 lie beyond the pole: in row −1 − i, half
    a turn further on; their costs only prepare the paths, and a block has none or only such steps.

    `costs`: what paths read. `front`: where all paths have come to before the block. `new_front`: written in the
    columns of the strip: where its paths have come to. `steps`: the first step, and how many. `strip`: the first
    column, and how many. `sums`: what is added to; strips of one block write disjoint entries. `state`: (3, D + 1, ·)
    uint16, scratch space of `state_columns` columns.
    """
    height, depth, width = costs.volume.shape
    (first_step, count), (first, lines) = steps, strip
    beyond = first_step < 0
    least = np.empty((3, state.shape[2]), np.uint16)
    state[:, depth] = OUTSIDE
    scratch = np.empty((2, lines + 2 * count), np.uint16)
    _take_front(front, first - count, lines + 2 * count, state, least)
    turn = width // 2 if beyond else 0
    for k in range(count):
        row = -1 - first_step - k if beyond else first_step + k
        row = height - 1 - row if costs.upward else row
        halo = count - 1 - k
        # Where the lines that come to the strip's first column are in the state.
        line = LINES + count, LINES + count - (k + 1), LINES + count + (k + 1)
        before = line[0] - halo, line[1] - halo, line[2] - halo
        after = line[0] + lines, line[1] + lines, line[2] + lines
        columns = first + turn
        _step_row(costs, row, (columns - halo, halo), 1, before, state, least, scratch, sums, False)
        _step_row(costs, row, (columns, lines), _ALL, line, state, least, scratch, sums, not beyond)
        _step_row(costs, row, (columns + lines, halo), 2, after, state, least, scratch, sums, False)
    for way in range(3):
        start, to = _U(LINES + count - (0, count, -count)[way]), _U(first)
        for i in range(_U(lines)):
            new_front.least[way, to + i] = least[way, start + i]
        for d in range(depth):
            for i in range(_U(lines)):
                new_front.paths[way, d, to + i] = state[way, d, start + i]
