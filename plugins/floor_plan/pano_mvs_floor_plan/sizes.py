"""Clear sizes of rooms, from wall to wall and from floor to ceiling, with their standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pano_mvs.algorithms.points.plan_grid import Storey, levels
from pano_mvs.core.arrays import FloatArray
from pano_mvs_floor_plan.evidence import PlanView
from pano_mvs_floor_plan.rooms import Room, Side, contains
from pano_mvs_floor_plan.wall_lines import Line

_NEAR_CELLS = 1.5
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
        length: the longer extent along its walls.
        width: the extent across.
        direction: (2,) unit vector of the length.
        is_rectangle: whether length and width are those of the whole room, not the largest ones.
        area: of the floor.
        perimeter: length of its outlines.
        height: from floor to ceiling; NaN unless both are level and were seen.
        sides: lengths of the sides of the outline.
    """

    length: Measure
    width: Measure
    direction: FloatArray
    is_rectangle: bool
    area: Measure
    perimeter: float
    height: Measure
    sides: list[Measure]

    @property
    def extent_text(self) -> str:
        """Length and width as text; the largest ones of a room that is not a rectangle are called so."""
        most = "" if self.is_rectangle else "max. "
        return f"{most}{self.length.value:.2f} × {self.width.value:.2f}"


def volume_of(size: RoomSize) -> Measure:
    """Return the volume below a level ceiling."""
    area, height = size.area, size.height
    std = float(np.hypot(area.std * height.value, height.std * area.value))
    return Measure(area.value * height.value, std)


class SizeEvidence:
    """What views tell of the places of walls, floors and ceilings.

    Errors of ranges on a surface are alike, so that their mean is taken to be no better than one of them.
    """

    def __init__(self, lines: Sequence[Line], rooms: Sequence[Room], *, cell: float) -> None:
        """Start without views; `cell`: edge of a cell in which surfaces were looked for."""
        self._lines, self._rooms, self._cell = lines, rooms, cell
        self._stds: list[list[FloatArray]] = [[] for _ in lines]
        # (N, 2) each: heights and their standard deviations, of level surfaces that face up, and that face down
        self._floors: list[list[FloatArray]] = [[] for _ in rooms]
        self._ceilings: list[list[FloatArray]] = [[] for _ in rooms]

    def add(self, view: PlanView) -> None:
        """Add a view."""
        if not len(view.points):
            return
        with np.errstate(invalid="ignore"):
            upright, level = np.abs(view.normals[:, 2]) < _UPRIGHT, np.abs(view.normals[:, 2]) > _FACING
        points, normals, errors = view.points[upright, :2], view.normals[upright, :2], view.point_errors[upright]
        for line, stds in zip(self._lines, self._stds, strict=True):
            near = np.abs(points @ line.normal - line.offset) < _NEAR_CELLS * self._cell
            near &= normals @ line.normal > _FACING
            stds.append(errors[near] * abs(float(view.center[:2] @ line.normal - line.offset)))
        points, up = view.points[level], view.normals[level, 2] > 0
        above = points[:, 2] - view.center[2]
        heights = np.column_stack([points[:, 2], view.point_errors[level] * np.abs(above)])
        for room, floors, ceilings in zip(self._rooms, self._floors, self._ceilings, strict=True):
            low, high = room.outline.min(axis=0), room.outline.max(axis=0)
            inside = np.flatnonzero(((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1))
            inside = inside[contains(room.outline, points[inside, :2])]
            floors.append(heights[inside[up[inside] & (above[inside] < 0)]])
            ceilings.append(heights[inside[~up[inside] & (above[inside] > 0)]])

    def sizes(self, sides: Sequence[Side], *, storey: Storey) -> list[RoomSize]:
        """Return the sizes of the rooms, with these sides in all.

        Sides on further lines, the edges of what was looked at, are of unknown position.
        """
        stds = np.array([*(_median(np.concatenate([np.zeros(0), *parts])) for parts in self._stds), np.nan])
        step = max(storey.height, 1e-9) / 400
        return [
            _room_size(
                room,
                [side for side in sides if side.room == number],
                stds,
                floor=_level(self._floors[number], step, highest=False),
                ceiling=_level(self._ceilings[number], step, highest=True),
            )
            for number, room in enumerate(self._rooms)
        ]


def _room_size(room: Room, sides: Sequence[Side], stds: FloatArray, *, floor: Measure, ceiling: Measure) -> RoomSize:
    own = stds[[min(side.line, len(stds) - 1) for side in sides]]
    ways = np.array([side.ends[1] - side.ends[0] for side in sides])
    lengths = np.linalg.norm(ways, axis=1)
    along = _main_direction(ways / lengths[:, None], lengths)
    across = np.array([-along[1], along[0]])
    length, width = (_extent(room.outline, sides, own, direction=one) for one in (along, across))
    if length.value < width.value:
        along, length, width = across, width, length
    # A wall that moves by its deviation adds its length times that to the area; pieces of one wall move together.
    by_line: dict[int, float] = {}
    for side, part, std in zip(sides, lengths, own, strict=True):
        by_line[side.line] = by_line.get(side.line, 0.0) + float(part * std)
    whole = length.value * width.value
    return RoomSize(
        length,
        width,
        along,
        bool(len(room.outline) == 4 and not room.holes and abs(room.area - whole) < 0.01 * whole),
        Measure(room.area, float(np.sqrt(sum(part**2 for part in by_line.values())))),
        float(lengths.sum()),
        Measure(ceiling.value - floor.value, float(np.hypot(floor.std, ceiling.std))),
        _side_lengths(room.outline, sides, own),
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


def _extent(outline: FloatArray, sides: Sequence[Side], stds: FloatArray, *, direction: FloatArray) -> Measure:
    """Return the extent of an outline along a direction."""
    places = outline @ direction
    middles = np.array([side.ends.mean(axis=0) @ direction for side in sides])
    low, high = float(stds[middles.argmin()]), float(stds[middles.argmax()])
    return Measure(float(np.ptp(places)), float(np.hypot(low, high)))


def _level(parts: Sequence[FloatArray], step: float, *, highest: bool) -> Measure:
    """Return the highest or the lowest large level of heights with standard deviations (N, 2)."""
    heights = np.concatenate([np.zeros((0, 2)), *parts])
    found = levels(heights[:, 0], step)
    if not found:
        return Measure(np.nan, np.nan)
    value = found[-1 if highest else 0]
    return Measure(value, _median(heights[np.abs(heights[:, 0] - value) < 3 * step, 1]))


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
