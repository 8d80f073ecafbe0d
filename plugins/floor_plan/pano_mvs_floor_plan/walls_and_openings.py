"""The plan of one storey: rooms, walls with their thickness, doors and windows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs_floor_plan.door_leaves import DoorLeaf, door_leaves
from pano_mvs_floor_plan.evidence import SURE, Evidence, PlanView
from pano_mvs_floor_plan.rooms import Room, Side, find_rooms
from pano_mvs_floor_plan.sizes import RoomSize, SizeEvidence
from pano_mvs_floor_plan.wall_lines import Line, wall_lines

_TOUCH = 1e-6
_ROWS = 64  # from floor to ceiling, in which a wall is looked at
# In nine rendered houses, these two limits find most of the openings and few others: of the mean score of what is open,
# and of how much larger it is than beside.
_OPEN, _MORE_OPEN = 0.25, 0.6


Behind = tuple[int, float, float, float]
"""The number of another side behind one, from where to where along this one, and how far behind."""


class Span(NamedTuple):
    """Where views see through a side: from start to end along it, and from bottom to top above the floor."""

    start: float
    end: float
    bottom: float  # 0: open down to the floor
    top: float


@dataclass(frozen=True, eq=False)
class Wall:
    """One side of a wall: its ends (2, 2) with the room on the left, its room, and its thickness, None if unknown."""

    ends: FloatArray
    room: int
    thickness: float | None


@dataclass(frozen=True, eq=False)
class Opening:
    """An opening in a wall: its ends (2, 2), in the middle of the wall if both sides were seen.

    `bottom`, `top`: of what was seen through, above the floor. `rooms`: those that it leads to. `thickness`: of the
    wall, None if unknown. `leaf`: of a door that stands open, None if none was seen.
    """

    ends: FloatArray
    kind: Literal["door", "window"]
    bottom: float
    top: float
    rooms: tuple[int, ...]
    thickness: float | None
    leaf: DoorLeaf | None = None

    @property
    def width(self) -> float:
        """The clear width."""
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))


@dataclass(frozen=True, eq=False)
class WallBody:
    """A piece of a wall with its openings: the ends (2, 2) of one side, with the room on the left, and its thickness.

    `rooms`: the room, and the one behind if both sides were seen; otherwise the thickness is None.
    """

    ends: FloatArray
    thickness: float | None
    rooms: tuple[int, ...]

    @property
    def back(self) -> FloatArray:
        """The direction (2,) from the side through the wall."""
        way = (self.ends[1] - self.ends[0]) / np.linalg.norm(self.ends[1] - self.ends[0])
        return np.array([way[1], -way[0]])

    @property
    def middle(self) -> FloatArray:
        """The middle (2,) of the wall."""
        return np.asarray(self.ends.mean(axis=0) + self.back * (self.thickness or 0.0) / 2)

    def contains(self, xy: FloatArray) -> bool:
        """Return whether a position (2,) is in the wall."""
        return self.distance(xy) < _TOUCH

    def distance(self, xy: FloatArray) -> float:
        """Return how far a position (2,) is from the wall."""
        way = self.ends[1] - self.ends[0]
        length = float(np.linalg.norm(way))
        along, across = float((xy - self.ends[0]) @ way / length), float((xy - self.ends[0]) @ self.back)
        beside = max(-along, along - length, 0.0), max(-across, across - (self.thickness or 0.0), 0.0)
        return float(np.hypot(*beside))


@dataclass(frozen=True, eq=False)
class StoreyPlan:
    """What is drawn of a storey; `solids` are the outlines (4, 2) of walls of which both sides were seen."""

    rooms: list[Room]
    sizes: list[RoomSize]
    walls: list[Wall]
    openings: list[Opening]
    solids: list[FloatArray]
    bodies: list[WallBody]

    def opening_counts(self, room: int) -> Counter[str]:
        """Return how many doors and windows a room has."""
        return Counter(opening.kind for opening in self.openings if room in opening.rooms)

    def openings_of(self, body: WallBody) -> list[Opening]:
        """Return the openings in a wall, each of which is in the nearest one with as much known of its thickness."""
        return [
            opening
            for opening in self.openings
            if body
            is min(
                (one for one in self.bodies if (one.thickness is None) == (opening.thickness is None)),
                key=lambda one: one.distance(opening.ends.mean(axis=0)),
                default=None,
            )
        ]


def plan_storey(
    evidence: Evidence,
    known: Sequence[Line],
    *,
    views: Callable[[], Iterable[PlanView]],
    cameras: FloatArray,
    min_share: float,
) -> StoreyPlan:
    """Return the plan of a storey.

    `evidence`: what the views show. `known`: lines of known planes. `views`: gives the views of the evidence, and is
    called up to four times. `cameras`: (N, 2) their positions. `min_share`: share of the height at which a wall must be
    seen.
    """
    evidence.recount(views())
    cells = evidence.wall_cells()
    lines = wall_lines(cells, known, min_share=min_share, min_length=0.15 * evidence.storey.height)
    rooms, sides = find_rooms(evidence, lines, cells=cells, cameras=cameras)
    frames = [_Frame(side, evidence) for side in sides]
    thickest, least = 0.2 * evidence.storey.height, evidence.extent.pixel
    measured = SizeEvidence(lines, rooms, sides, cell=evidence.extent.pixel)
    for view in views():
        measured.add(view)
        for frame in frames:
            frame.add(view)
    hidden = [
        [(idx, *place) for idx, other in enumerate(frames) if (place := frame.behind(other, thickest)) is not None]
        for frame in frames
    ]
    walls: list[Wall] = []
    openings: list[Opening] = []
    solids: list[FloatArray] = []
    for idx, frame in enumerate(frames):
        spans = frame.open_spans([frames[other] for other, *_ in hidden[idx]])
        for start, end, bottom, top in spans:
            depth = _depth_at((start + end) / 2, hidden[idx])
            ends = frame.xy_of(start, end) + frame.back * depth / 2
            if not any(np.linalg.norm((one.ends - ends).mean(axis=0)) < thickest / 2 for one in openings):
                beyond = {
                    frames[other].side.room for other, first, last, _ in hidden[idx] if first < end and start < last
                }
                rooms_beside = tuple(sorted({frame.side.room, *beyond}))
                kind: Literal["door", "window"] = "window" if bottom else "door"
                openings.append(Opening(ends, kind, bottom, top, rooms_beside, depth or None))
        edges = [0.0, *(edge for start, end, *_ in spans for edge in (start, end)), frame.length]
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            if end - start < least or frame.side.line >= len(lines):  # the edge of the extent
                continue
            pieces = [(max(first, start), min(last, end), depth) for _, first, last, depth in hidden[idx]]
            pieces = [piece for piece in pieces if piece[1] - piece[0] > least]
            for first, last, depth in pieces:
                side = frame.xy_of(*_to_corners(idx, first, last, frames=frames, hidden=hidden))
                solids.append(np.concatenate([side, side[::-1] + frame.back * depth]))
            walls.append(Wall(frame.xy_of(start, end), frame.side.room, pieces[0][2] if pieces else None))
    bodies = _bodies(frames, hidden, lines=len(lines), least=least)
    doors = [(one.ends, one.thickness or 0.0) for one in openings if one.kind == "door"]
    # An open leaf gives a line too, but no side of a room.
    bounding = [lines[number] for number in sorted({side.line for side in sides if side.line < len(lines)})]
    leaves = iter(
        door_leaves(doors, views=views, lines=bounding, storey=evidence.storey, cell=evidence.extent.pixel)
        if doors
        else ()
    )
    openings = [replace(one, leaf=next(leaves)) if one.kind == "door" else one for one in openings]
    return StoreyPlan(rooms, measured.sizes(storey=evidence.storey), walls, openings, solids, bodies)


def _bodies(
    frames: Sequence[_Frame], hidden: Sequence[Sequence[Behind]], *, lines: int, least: float
) -> list[WallBody]:
    """Return the walls with their openings, each once, those on the edges of the extent left out."""
    known: list[WallBody] = []
    for idx, frame in enumerate(frames):
        for other, first, last, depth in hidden[idx] if frame.side.line < lines else ():
            first, last = max(first, 0.0), min(last, frame.length)
            ends = frame.xy_of(*_to_corners(idx, first, last, frames=frames, hidden=hidden))
            body = WallBody(ends, depth, (frame.side.room, frames[other].side.room))
            # Both sides give the same wall, and the four sides of a pillar two.
            if last - first > least and not any(one.contains(body.middle) for one in known):
                known.append(body)
    unknown = []
    for frame, behind in zip(frames, hidden, strict=True):
        if frame.side.line >= lines:
            continue
        edges = [0.0]
        for _, first, last, _ in sorted(behind, key=lambda one: one[1]):
            edges += [max(first, 0.0), min(last, frame.length)]
        edges.append(frame.length)
        for start, end in zip(np.maximum.accumulate(edges[::2]), edges[1::2], strict=True):
            body = WallBody(frame.xy_of(start, end), None, (frame.side.room,))
            # Where another wall meets the side from behind, this is the wall there.
            if end - start > least and not any(one.contains(body.middle + least * frame.back) for one in known):
                unknown.append(body)
    return known + unknown


def _to_corners(
    idx: int, first: float, last: float, *, frames: Sequence[_Frame], hidden: Sequence[Sequence[Behind]]
) -> tuple[float, float]:
    """Return a piece of a side that at a corner goes on as far as the wall around it is thick."""
    frame = frames[idx]
    if first == 0:
        around = _corners(frame, frames, 0)
        first -= max((_depth_at(frames[one].length, hidden[one]) for one in around), default=0.0)
    if last == frame.length:
        around = _corners(frame, frames, 1)
        last += max((_depth_at(0.0, hidden[one]) for one in around), default=0.0)
    return first, last


def _depth_at(place: float, hidden: Sequence[Behind]) -> float:
    """Return the thickness of a wall at a place along its side, 0 if unknown."""
    return next((depth for _, first, last, depth in hidden if first - depth <= place <= last + depth), 0.0)


def _corners(frame: _Frame, frames: Sequence[_Frame], end: int) -> list[int]:
    """Return the sides that meet the start (0) or the end (1) of a side in a corner of less than 180° of the room."""
    turn = 1 if end else -1
    return [
        idx
        for idx, other in enumerate(frames)
        if np.allclose(other.side.ends[1 - end], frame.side.ends[end], rtol=0, atol=1e-6)
        and turn * float(np.linalg.det([frame.along, other.along])) > 0.1
    ]


class _Frame:
    """Coordinates along and behind a side of a wall, and whether views see the wall or through it, seen from the front.

    `scores`: (rows, columns) of cells between floor and ceiling.
    """

    def __init__(self, side: Side, evidence: Evidence) -> None:
        self.side = side
        way = side.ends[1] - side.ends[0]
        self.length = float(np.linalg.norm(way))
        self.along = way / self.length
        self.back = np.array([self.along[1], -self.along[0]])
        self.cell, storey = evidence.extent.pixel, evidence.storey
        self.height = storey.height
        self._columns = side.ends[0] + (np.arange(int(self.length / self.cell)) + 0.5)[:, None] * self.cell * self.along
        self._rows = storey.floor + (np.arange(_ROWS) + 0.5)[:, None, None] / _ROWS * storey.height
        self.scores = np.zeros((_ROWS, len(self._columns)))

    def add(self, view: PlanView) -> None:
        """Add what a view before the side shows of it."""
        before = float((self.side.ends[0] - view.center[:2]) @ self.back)
        if before < self.cell or not len(view.points) or not self.scores.size:
            return
        low, high = view.box()
        if (self.side.ends.max(axis=0) < low).any() or (self.side.ends.min(axis=0) > high).any():
            return
        places = [np.broadcast_to(one, (*self.scores.shape, one.shape[-1])) for one in (self._columns, self._rows)]
        away, pixels = view.pixels_of(np.concatenate(places, axis=2))
        errors = view.errors[pixels]
        # What a view is worth, from a logistic regression on nine rendered houses: one that sees through an opening in
        # a range of which it is not sure half as much, one that sees the wall a fifth, what was filled nothing.
        worth = np.where(errors <= SURE, 1.0, 0.5)
        with np.errstate(invalid="ignore"):
            behind = (view.seen[pixels] - away) * before / away
            near = 1.5 * self.cell + 2 * errors * before
            on_it, panes = np.abs(behind) <= near, view.panes[pixels]
            self.scores += worth * ((behind > np.maximum(near, 0.06 * self.height)) | on_it & panes)
            self.scores -= 0.2 * (worth == 1) * (on_it & ~panes)

    def xy_of(self, start: float, end: float) -> FloatArray:
        """Return the positions (2, 2) of two places along the side."""
        return np.asarray(self.side.ends[0] + np.array([[start], [end]]) * self.along)

    def along_of(self, xy: FloatArray) -> tuple[float, float]:
        """Return the places of two positions (2, 2) along the side, in rising order."""
        first, last = sorted(((xy - self.side.ends[0]) @ self.along).tolist())
        return first, last

    def behind(self, other: _Frame, thickest: float) -> tuple[float, float, float] | None:
        """Return start, end and depth of another side behind this one; None unless it faces away."""
        depth = float(((other.side.ends - self.side.ends[0]) @ self.back).mean())
        first, last = self.along_of(other.side.ends)
        opposite = self.along @ other.along < -np.cos(np.deg2rad(5.0))
        beside = min(last, self.length) <= max(first, 0.0)
        return (first, last, depth) if opposite and 0 < depth < thickest and not beside else None

    def open_spans(self, others: Sequence[_Frame]) -> list[Span]:
        """Return where views see through the side or through others behind it."""
        scores = self.scores.copy()
        for other in others:
            last, first = (((other.side.ends - self.side.ends[0]) @ self.along) / self.cell).tolist()
            own = np.arange(max(0, round(first)), min(scores.shape[1], round(last)))
            theirs = np.rint(last - 1 - own).astype(np.int64)
            kept = (theirs >= 0) & (theirs < other.scores.shape[1])
            scores[:, own[kept]] += other.scores[:, theirs[kept]]
        scores = scores.clip(-1, 1)
        if others:  # to another room
            return [
                Span(start, end, 0.0, self._levels(scores, start, end)[1])
                for start, end in self._spans(scores[_ROWS // 16 : _ROWS * 3 // 4])
            ]
        # Rows below window sills, and those of windows; both are open in doors.
        low, high = scores[_ROWS // 16 : _ROWS * 5 // 16], scores[_ROWS * 3 // 8 : _ROWS * 3 // 4]
        found = []
        for start, end in self._spans(high):
            part = slice(round(start / self.cell), round(end / self.cell))
            bottom, top = self._levels(scores, start, end)
            is_door = low[:, part].mean() > high[:, part].mean() / 2
            found.append(Span(start, end, 0.0 if is_door else max(bottom, self.height / _ROWS), top))
        return found

    def _levels(self, scores: FloatArray, start: float, end: float) -> tuple[float, float]:
        """Return between which heights above the floor views see through a span."""
        mean = scores[:, round(start / self.cell) : round(end / self.cell)].mean(axis=1)
        opened = np.flatnonzero(mean > _OPEN)
        runs = np.split(opened, np.flatnonzero(np.diff(opened) > 2) + 1)  # muntins are narrower
        longest = max(runs, key=len)
        if not len(longest):
            return 0.0, self.height
        return float(longest[0] / _ROWS * self.height), float((longest[-1] + 1) / _ROWS * self.height)

    def _spans(self, scores: FloatArray) -> list[tuple[float, float]]:
        """Return where rows of the side are open."""
        mean = scores.mean(axis=0)
        opened = np.flatnonzero(mean > _OPEN)
        near = round(0.15 * self.height / self.cell)
        spans = []
        for part in np.split(opened, np.flatnonzero(np.diff(opened) > 0.06 * self.height / self.cell + 1) + 1):
            if len(part) and (part[-1] + 1 - part[0]) * self.cell >= 0.2 * self.height:
                first, last = int(part[0]), int(part[-1]) + 1
                around = np.concatenate([mean[max(first - near, 0) : first], mean[last : last + near], np.zeros(1)])
                if mean[first:last].mean() > around.mean() + _MORE_OPEN:
                    spans.append((first * self.cell, last * self.cell))
        return spans
