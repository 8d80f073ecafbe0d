"""Clear sizes of rooms, from wall to wall and from floor to ceiling, with their standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pano_mvs.algorithms.points.plan_grid import Storey, levels
from pano_mvs.core.arrays import FloatArray
from pano_mvs_floor_plan.evidence import PlanView
from pano_mvs_floor_plan.rooms import Room, Side
from pano_mvs_floor_plan.wall_lines import Line

_NEAR_CELLS = 1.5
_MOST_HEIGHTS = 200  # that are kept of a surface in a view
_UPRIGHT, _FACING = 0.35, np.cos(np.deg2rad(25.0))  # of normals
_PARALLEL = np.sin(np.deg2rad(3.0))


class Measure(NamedTuple):
    """A length or an area with its standard deviation; NaN is what is not known."""

    value: float
    std: float


@dataclass(frozen=True, eq=False)
class RoomSize:
    """The clear sizes of a room.

    Attributes:
        length: the longer extent along its walls; NaN if it ends where nothing was seen.
        width: the extent across, likewise.
        direction: (2,) unit vector of the length.
        is_closed: whether walls were seen on all sides; otherwise area and perimeter are those of what was seen.
        is_rectangle: whether length and width are those of the whole room, not the largest ones.
        area: of the floor.
        perimeter: length of its outlines.
        height: from floor to ceiling; NaN unless both are level and were seen.
        sides: lengths of the sides of the outline.
    """

    length: Measure
    width: Measure
    direction: FloatArray
    is_closed: bool
    is_rectangle: bool
    area: Measure
    perimeter: float
    height: Measure
    sides: list[Measure]

    @property
    def extent_text(self) -> str:
        """Length and width as text; the largest ones of a room that is not a rectangle are called so."""
        most = "" if self.is_rectangle or not self.is_closed else "max. "
        length, width = ("open" if np.isnan(one.value) else f"{one.value:.2f}" for one in (self.length, self.width))
        return f"{most}{length} × {width}"

    @property
    def extent_std(self) -> float:
        """The larger standard deviation of length and width; NaN if one is not known."""
        stds = [one.std for one in (self.length, self.width) if not np.isnan(one.value)]
        return float(np.max(stds)) if stds else float("nan")


def volume_of(size: RoomSize) -> Measure:
    """Return the volume below a level ceiling; NaN unless the room is closed."""
    area, height = size.area, size.height
    if not size.is_closed:
        return Measure(np.nan, np.nan)
    std = float(np.hypot(area.std * height.value, height.std * area.value))
    return Measure(area.value * height.value, std)


class SizeEvidence:
    """What views tell of the places of walls, floors and ceilings.

    Errors of ranges on a surface are alike, so that their mean is taken to be no better than one of them.
    """

    def __init__(self, lines: Sequence[Line], rooms: Sequence[Room], sides: Sequence[Side], *, cell: float) -> None:
        """Start without views; `sides`: of all rooms; `cell`: edge of a cell in which surfaces were looked for."""
        self._lines, self._rooms, self._sides, self._cell = lines, rooms, sides, cell
        # Where the sides on each line are, (2, 2) lower and upper corner.
        self._boxes = {
            number: _box(np.concatenate([side.ends for side in sides if side.line == number]))
            for number in sorted({side.line for side in sides if side.line < len(lines)})
        }
        # Of each view that sees a line: the median of its standard deviations, and how many these are.
        self._stds: list[list[tuple[float, int]]] = [[] for _ in lines]
        # (N, 2) each: heights and their standard deviations, of level surfaces that face up, and that face down
        self._floors: list[list[FloatArray]] = [[] for _ in rooms]
        self._ceilings: list[list[FloatArray]] = [[] for _ in rooms]

    def add(self, view: PlanView) -> None:
        """Add a view."""
        if not len(view.points):
            return
        low, high = view.box()
        with np.errstate(invalid="ignore"):
            upright, level = np.abs(view.normals[:, 2]) < _UPRIGHT, np.abs(view.normals[:, 2]) > _FACING
        points, normals, errors = view.points[upright, :2], view.normals[upright, :2], view.point_errors[upright]
        for number, box in self._boxes.items():
            if (box[1] < low).any() or (box[0] > high).any():
                continue
            line = self._lines[number]
            near = np.abs(points @ line.normal - line.offset) < _NEAR_CELLS * self._cell
            near &= normals @ line.normal > _FACING
            if near.any():
                distance = abs(float(view.center[:2] @ line.normal - line.offset))
                self._stds[number].append((_median(errors[near]) * distance, int(near.sum())))
        points, up = view.points[level], view.normals[level, 2] > 0
        above = points[:, 2] - view.center[2]
        heights = np.column_stack([points[:, 2], view.point_errors[level] * np.abs(above)])
        for room, floors, ceilings in zip(self._rooms, self._floors, self._ceilings, strict=True):
            lower, upper = _box(room.outline)
            if (upper < low).any() or (lower > high).any():
                continue
            inside = np.flatnonzero(((points[:, :2] > lower) & (points[:, :2] < upper)).all(axis=1))
            inside = inside[room.contains(points[inside, :2])]
            for parts, chosen in (
                (floors, inside[up[inside] & (above[inside] < 0)]),
                (ceilings, inside[~up[inside] & (above[inside] > 0)]),
            ):
                parts.append(heights[chosen[:: 1 + len(chosen) // _MOST_HEIGHTS]])

    def sizes(self, *, storey: Storey) -> list[RoomSize]:
        """Return the sizes of the rooms."""
        stds = np.array([_weighted_median(parts) for parts in self._stds])
        step = max(storey.height, 1e-9) / 400
        return [
            _room_size(
                room,
                [side for side in self._sides if side.room == number],
                stds,
                floor=_level(self._floors[number], step, highest=False),
                ceiling=_level(self._ceilings[number], step, highest=True),
            )
            for number, room in enumerate(self._rooms)
        ]


def _room_size(room: Room, sides: Sequence[Side], stds: FloatArray, *, floor: Measure, ceiling: Measure) -> RoomSize:
    # Beyond the lines of walls are the edges of what was looked at.
    is_wall = [side.line < len(stds) for side in sides]
    own = np.array([stds[side.line] if wall else np.nan for side, wall in zip(sides, is_wall, strict=True)])
    ways = np.array([side.ends[1] - side.ends[0] for side in sides])
    lengths = np.linalg.norm(ways, axis=1)
    along = _main_direction(ways / lengths[:, None], lengths)
    across = np.array([-along[1], along[0]])
    if np.ptp(room.outline @ along) < np.ptp(room.outline @ across):
        along, across = across, -along
    whole = float(np.prod([np.ptp(room.outline @ one) for one in (along, across)]))
    # A wall that moves by its deviation adds its length times that to the area; pieces of one wall move together.
    by_line: dict[int, float] = {}
    for side, part, std in zip(sides, lengths, own, strict=True):
        by_line[side.line] = by_line.get(side.line, 0.0) + float(part * std)
    return RoomSize(
        length=_extent(room.outline, sides, own, direction=along, is_wall=is_wall),
        width=_extent(room.outline, sides, own, direction=across, is_wall=is_wall),
        direction=along,
        is_closed=all(is_wall),
        is_rectangle=bool(len(room.outline) == 4 and not room.holes and abs(room.area - whole) < 0.01 * whole),
        area=Measure(room.area, float(np.sqrt(sum(part**2 for part in by_line.values())))),
        perimeter=float(lengths.sum()),
        height=Measure(ceiling.value - floor.value, float(np.hypot(floor.std, ceiling.std))),
        sides=_side_lengths(room.outline, sides, own),
    )


def _side_lengths(outline: FloatArray, sides: Sequence[Side], stds: FloatArray) -> list[Measure]:
    """Return the lengths of the sides of an outline, each of which ends at the walls beside it."""
    starts = np.array([side.ends[0] for side in sides])
    std_of = [float(stds[np.linalg.norm(starts - corner, axis=1).argmin()]) for corner in outline]
    lengths = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1).tolist()
    return [
        Measure(length, float(np.hypot(std_of[idx - 1], std_of[(idx + 1) % len(std_of)])))
        for idx, length in enumerate(lengths)
    ]


def _main_direction(along: FloatArray, lengths: FloatArray) -> FloatArray:
    """Return the direction that most of the length of walls has, or is at right angles to."""
    cosines = np.abs(along @ along.T)
    agree = (cosines < _PARALLEL) | (cosines > np.cos(np.arcsin(_PARALLEL)))
    best = int(np.argmax(agree @ lengths + 1e-6 * lengths))
    return np.asarray(along[best])


def _extent(
    outline: FloatArray,
    sides: Sequence[Side],
    stds: FloatArray,
    *,
    direction: FloatArray,
    is_wall: Sequence[bool],
) -> Measure:
    """Return the extent of an outline along a direction; NaN if it ends at an edge of what was looked at."""
    middles = np.array([side.ends.mean(axis=0) @ direction for side in sides])
    ends = int(middles.argmin()), int(middles.argmax())
    if not all(is_wall[end] for end in ends):
        return Measure(np.nan, np.nan)
    return Measure(float(np.ptp(outline @ direction)), float(np.hypot(*stds[list(ends)])))


def _level(parts: Sequence[FloatArray], step: float, *, highest: bool) -> Measure:
    """Return the highest or the lowest large level of heights with standard deviations (N, 2)."""
    heights = np.concatenate([np.zeros((0, 2)), *parts])
    found = levels(heights[:, 0], step)
    if not found:
        return Measure(np.nan, np.nan)
    value = found[-1 if highest else 0]
    return Measure(value, _median(heights[np.abs(heights[:, 0] - value) < 3 * step, 1]))


def _box(xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    return xy.min(axis=0), xy.max(axis=0)


def _weighted_median(parts: Sequence[tuple[float, int]]) -> float:
    """Return the median of values with weights, without NaN; NaN if there are none."""
    known = sorted((value, weight) for value, weight in parts if np.isfinite(value))
    if not known:
        return np.nan
    values, weights = np.array(known).T
    sums = np.cumsum(weights)
    return float(values[np.searchsorted(sums, sums[-1] / 2)])


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
