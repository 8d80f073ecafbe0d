"""Rooms of a storey: the cells between the lines of its walls that are free below the ceiling.

The lines cut the plan into convex cells. A cell is inside if views see through it just below the ceiling, above most
furniture and all doors and windows. What is before a wall that was seen is inside, what is behind it outside, and
borders where no wall was seen cost something. The cheapest labelling is a minimum cut. So outlines are closed, and
their corners are where lines cross.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs_floor_plan.evidence import TOP, Evidence, WallCells
from pano_mvs_floor_plan.wall_lines import Line


@dataclass(frozen=True, eq=False)
class Edges:
    """The pieces of lines between their crossings.

    `line`: (E,) number of the line. `ends`: (E, 2, 2), with the front of the line on the left. `front`, `back`: (E,)
    the cells beside each. `signs`: (C, B) of each cell, on which sides of the lines it is, as packed bits.
    """

    line: NDArray[np.int64]
    ends: FloatArray
    front: NDArray[np.int64]
    back: NDArray[np.int64]
    signs: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Side:
    """One side of a wall: its ends, (2, 2), with the room on the left; the number of its line and of its room."""

    ends: FloatArray
    line: int
    room: int


@dataclass(frozen=True, eq=False)
class Room:
    """A room: its outline, (N, 2) counter-clockwise, those of what it goes around, its area, and a camera in it."""

    outline: FloatArray
    holes: list[FloatArray]
    area: float
    label_xy: FloatArray

    def contains(self, xy: FloatArray) -> NDArray[np.bool_]:
        """Return which positions (N, 2) are in the room."""
        inside = contains(self.outline, xy)
        for hole in self.holes:
            inside &= ~contains(hole, xy)
        return inside


def find_rooms(
    evidence: Evidence, lines: Sequence[Line], *, cells: WallCells, cameras: FloatArray
) -> tuple[list[Room], list[Side]]:
    """Return the rooms in which cameras (N, 2) stand, and the sides of their walls."""
    if not lines:
        return [], []
    edges = _edges(evidence, lines)
    owner = _owners(evidence, edges, lines)
    inside = _labels(evidence, edges, lines, cells=cells, owner=owner)
    room = _components(edges, inside)
    borders = [
        (room[one], ends[:: 1 if one == front else -1], int(line))
        for front, back, ends, line in zip(edges.front, edges.back, edges.ends, edges.line, strict=True)
        if inside[front] != inside[back]
        for one in ((front,) if inside[front] else (back,))
    ]
    rooms, sides = [], []
    for number in range(room.max() + 1):
        loops = [_straight(loop) for loop in _loops([(ends, line) for which, ends, line in borders if which == number])]
        outlines = [np.array([ends[0] for ends, _ in loop]) for loop in loops]
        areas = [_area(outline) for outline in outlines]
        outer = int(np.argmax(areas))
        holes = [one for idx, one in enumerate(outlines) if idx != outer]
        stand_in = contains(outlines[outer], cameras)
        for hole in holes:
            stand_in &= ~contains(hole, cameras)
        within = cameras[stand_in]
        if not len(within):
            continue
        rooms.append(Room(outlines[outer], holes, sum(areas), within[0]))
        sides += [Side(ends, line, len(rooms) - 1) for loop in loops for ends, line in loop]
    return rooms, sides


def _edges(evidence: Evidence, lines: Sequence[Line]) -> Edges:
    """Return the pieces of the lines, and then of the edges of the extent, between their crossings."""
    extent = evidence.extent
    rows, columns = extent.size_hw
    low = np.array([extent.left, extent.top - rows * extent.pixel])
    high = np.array([extent.left + columns * extent.pixel, extent.top])
    normals = np.array([*(line.normal for line in lines), (1, 0), (0, 1), (-1, 0), (0, -1)], np.float64)
    offsets = np.array([*(line.offset for line in lines), low[0], low[1], -high[0], -high[1]])
    numbers, ends = [], []
    fronts: list[NDArray[np.uint8]] = []
    backs: list[NDArray[np.uint8]] = []
    for number, (normal, offset) in enumerate(zip(normals, offsets, strict=True)):
        start, along = normal * offset, np.array([normal[1], -normal[0]])
        slope = normals @ along
        crossing = np.abs(slope) > 1e-3
        places = np.sort((offsets - normals @ start)[crossing] / slope[crossing])
        points = start + places[:, None] * along
        within = ((points >= low - 1e-9) & (points <= high + 1e-9)).all(axis=1)
        pieces = np.stack([points[within][:-1], points[within][1:]], axis=1)
        pieces = pieces[np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1) > 1e-9]
        signs = pieces.mean(axis=1) @ normals.T > offsets
        for is_front, sides in ((True, fronts), (False, backs)):
            signs[:, number] = is_front
            sides.append(np.packbits(signs, axis=1))
        numbers.append(np.full(len(pieces), number))
        ends.append(pieces)
    sides_of_lines = np.concatenate([*fronts, *backs])
    cells, numbered = np.unique(sides_of_lines, axis=0, return_inverse=True)
    front, back = np.split(numbered.reshape(-1), 2)
    return Edges(np.concatenate(numbers), np.concatenate(ends), front, back, cells)


def _labels(
    evidence: Evidence, edges: Edges, lines: Sequence[Line], *, cells: WallCells, owner: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return which cells are inside: the minimum cut."""
    count, height = len(edges.signs), evidence.storey.height
    unit = 1e5 / height**2  # capacities are whole numbers
    length = np.linalg.norm(edges.ends[:, 1] - edges.ends[:, 0], axis=1)
    gap = 0.2 * height  # the narrowest passage between two parts of a room
    seen = np.zeros(len(length))
    for number, line in enumerate(lines):
        own = edges.line == number
        seen[own] = _seen_lengths(line, edges.ends[own], cells, gap=gap)
    is_free = evidence.free > evidence.hits[:, TOP].sum(axis=1)
    gain = np.bincount(owner, np.where(is_free, 1.0, -1.0), count + 1)[:count] * evidence.extent.pixel**2
    # Of a wall that was seen, the gain of a cell before it and the loss of one behind it, and of a border in which none
    # was seen, the cost, as areas per length. On four rendered houses, half or twice the values change the share of
    # walls that are found by a few percent.
    for side, sign in ((edges.front, 1), (edges.back, -1)):
        gain += np.bincount(side, sign * 0.4 * height * seen, count)
    gain = np.clip(gain * unit, -1e9, 1e9)  # in 32 bits
    gain[edges.back[edges.line >= len(lines)]] = -1e9  # beyond the extent
    full, cost = (0.05 * height * unit * unseen for unseen in (length, length - seen))
    source, sink, every = count, count + 1, np.arange(count)
    start = np.concatenate([edges.front, edges.back, np.full(count, source), every])
    end = np.concatenate([edges.back, edges.front, every, np.full(count, sink)])
    capacity = np.rint(np.concatenate([cost, full, np.maximum(gain, 0), np.maximum(-gain, 0)])).astype(np.int64)
    graph = scipy.sparse.coo_array((capacity, (start, end)), shape=(count + 2, count + 2)).tocsr().astype(np.int32)
    left = graph - scipy.sparse.csgraph.maximum_flow(graph, source, sink).flow
    left.eliminate_zeros()
    reached = scipy.sparse.csgraph.breadth_first_order(left, source, return_predecessors=False)
    inside = np.zeros(count + 2, np.bool_)
    inside[reached] = True
    return inside[:count]


def _owners(evidence: Evidence, edges: Edges, lines: Sequence[Line]) -> NDArray[np.int64]:
    """Return the cell between lines in which each pixel of the evidence is; their number if in none."""
    xy = evidence.extent.centers()
    normals, offsets = np.array([line.normal for line in lines]), np.array([line.offset for line in lines])
    edge = np.ones((1, 4), np.bool_)  # all are within the extent
    signs = np.concatenate([
        np.packbits(np.concatenate([part @ normals.T > offsets, edge.repeat(len(part), axis=0)], axis=1), axis=1)
        for part in np.array_split(xy, 1 + len(xy) // 50_000)  # to save memory
    ])  # fmt: skip
    order = {one.tobytes(): number for number, one in enumerate(edges.signs)}
    shapes, inverse = np.unique(signs, axis=0, return_inverse=True)
    return np.array([order.get(one.tobytes(), len(order)) for one in shapes])[inverse.reshape(-1)]


def _seen_lengths(line: Line, ends: FloatArray, cells: WallCells, *, gap: float) -> FloatArray:
    """Return the length of pieces (N, 2, 2) of a line at which a wall was seen just below the ceiling.

    Gaps of up to a width count as seen.
    """
    held = line.holds(cells, within=1.5) & cells.layers[:, TOP].any(axis=1)
    places = np.unique(np.floor(cells.xy[held] @ line.along / cells.cell)) * cells.cell
    if not len(places):
        return np.zeros(len(ends))
    steps = np.append(np.diff(places), cells.cell)
    lengths = np.where(steps <= gap + cells.cell, steps, cells.cell)
    until = np.cumsum(lengths)
    known, seen = np.column_stack([places, places + lengths]), np.column_stack([until - lengths, until])
    return np.asarray(np.diff(np.interp(ends @ line.along, known.ravel(), seen.ravel()), axis=1)[:, 0])


def _components(edges: Edges, inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of the room of each cell, −1 outside."""
    both = inside[edges.front] & inside[edges.back]
    count = len(inside)
    graph = scipy.sparse.coo_array((np.ones(both.sum()), (edges.front[both], edges.back[both])), shape=(count, count))
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    numbers = np.full(count, -1, np.int64)
    _, numbers[inside] = np.unique(label[inside], return_inverse=True)
    return numbers


Piece = tuple[FloatArray, int]


def _loops(pieces: Sequence[Piece]) -> list[list[Piece]]:
    """Return directed pieces as closed loops; where several go on, the sharpest turn to the left does."""

    def key(point: FloatArray) -> tuple[int, int]:
        x, y = np.rint(point * 1e6).astype(np.int64).tolist()
        return x, y

    after: dict[tuple[int, int], list[int]] = {}
    for number, (ends, _) in enumerate(pieces):
        after.setdefault(key(ends[0]), []).append(number)
    left, loops = set(range(len(pieces))), []
    while left:
        number, loop = min(left), []
        while number in left:
            left.remove(number)
            loop.append(pieces[number])
            ends = pieces[number][0]
            choices = [one for one in after.get(key(ends[1]), []) if one in left]
            if not choices:
                break
            number = max(choices, key=lambda one: _turn(ends, pieces[one][0]))
        loops.append(loop)
    return loops


def _turn(first: FloatArray, second: FloatArray) -> float:
    a, b = first[1] - first[0], second[1] - second[0]
    return float(np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b))


def _straight(loop: list[Piece]) -> list[Piece]:
    """Return a loop with pieces of one line joined."""
    result: list[Piece] = []
    for ends, line in loop:
        if result and result[-1][1] == line:
            result[-1] = (np.array([result[-1][0][0], ends[1]]), line)
        else:
            result.append((ends, line))
    if len(result) > 1 and result[0][1] == result[-1][1]:
        result[0] = (np.array([result[-1][0][0], result[0][0][1]]), result[0][1])
        result.pop()
    return result


def contains(outline: FloatArray, xy: FloatArray) -> NDArray[np.bool_]:
    """Return which positions (N, 2) an outline goes around, by the even-odd rule."""
    (x0, y0), (x1, y1) = outline.T[:, :, None], np.roll(outline, -1, axis=0).T[:, :, None]
    crosses = (xy[:, 1] < y0) != (xy[:, 1] < y1)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = xy[:, 0] < x0 + (xy[:, 1] - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray((crosses & left).sum(axis=0) % 2 == 1)


def _area(outline: FloatArray) -> float:
    x, y = outline.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
