"""The plan of one storey: rooms, walls with their thickness, doors and windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.floor_plan.evidence import LAYERS, Evidence
from pano_mvs.algorithms.floor_plan.rooms import Room, Side, find_rooms
from pano_mvs.algorithms.floor_plan.wall_lines import Line, wall_lines
from pano_mvs.core.arrays import FloatArray

Span = tuple[float, float, bool]  # start and end along a side, and whether it is open down to the floor


@dataclass(frozen=True, eq=False)
class Wall:
    """One side of a wall: its ends (2, 2) with the room on the left, its room, and its thickness, None if unknown."""

    ends: FloatArray
    room: int
    thickness: float | None


@dataclass(frozen=True, eq=False)
class Opening:
    """An opening in a wall: its ends (2, 2), in the middle of the wall if both sides were seen."""

    ends: FloatArray
    kind: Literal["door", "window"]


@dataclass(frozen=True, eq=False)
class StoreyPlan:
    """What is drawn of a storey; `solids` are the outlines (4, 2) of walls of which both sides were seen."""

    rooms: list[Room]
    walls: list[Wall]
    openings: list[Opening]
    solids: list[FloatArray]


def plan_storey(evidence: Evidence, known: Sequence[Line], *, cameras: FloatArray, min_share: float) -> StoreyPlan:
    """Return the plan of a storey.

    `evidence`: what the views show. `known`: lines of known planes. `cameras`: (N, 2) their positions. `min_share`:
    share of the height at which a wall must be seen.
    """
    cells = evidence.wall_cells()
    least = 0.15 * evidence.storey.height / cells.cell * min_share * LAYERS
    lines = wall_lines(cells, known, min_area=least)
    rooms, sides = find_rooms(evidence, lines, cells=cells, cameras=cameras)
    frames = [_Frame(side) for side in sides]
    thickest, least = 0.2 * evidence.storey.height, evidence.extent.pixel
    open_spans = [_open_spans(evidence, frame) for frame in frames]
    hidden = [
        [(idx, *place) for idx, other in enumerate(frames) if (place := frame.behind(other, thickest)) is not None]
        for frame in frames
    ]
    walls: list[Wall] = []
    openings: list[Opening] = []
    solids: list[FloatArray] = []
    for idx, frame in enumerate(frames):
        from_behind = [
            (*frame.along_of(frames[other].xy_of(start, end)), low)
            for other, *_ in hidden[idx]
            for start, end, low in open_spans[other]
        ]
        spans = _joined([*open_spans[idx], *from_behind], frame.length)
        for start, end, low in spans:
            depth = _depth_at((start + end) / 2, hidden[idx])
            ends = frame.xy_of(start, end) + frame.back * depth / 2
            if not any(np.linalg.norm((one.ends - ends[::-1]).mean(axis=0)) < (end - start) / 2 for one in openings):
                # What leads to another room is a door.
                openings.append(Opening(ends, "door" if low or depth else "window"))
        edges = [0.0, *(edge for start, end, _ in spans for edge in (start, end)), frame.length]
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            if end - start < least or frame.side.line >= len(lines):  # the edge of the extent
                continue
            pieces = [(max(first, start), min(last, end), depth) for _, first, last, depth in hidden[idx]]
            pieces = [piece for piece in pieces if piece[1] - piece[0] > least]
            for first, last, depth in pieces:
                # As far as the wall around the corner is thick.
                before = max((_depth_at(frames[one].length, hidden[one])
                              for one in _corners(frame, frames, 0) if first == 0), default=0.0)  # fmt: skip
                after = max((_depth_at(0.0, hidden[one])
                             for one in _corners(frame, frames, 1) if last == frame.length), default=0.0)  # fmt: skip
                side = frame.xy_of(first - before, last + after)
                solids.append(np.concatenate([side, side[::-1] + frame.back * depth]))
            walls.append(Wall(frame.xy_of(start, end), frame.side.room, pieces[0][2] if pieces else None))
    return StoreyPlan(rooms, walls, openings, solids)


def _depth_at(place: float, hidden: Sequence[tuple[int, float, float, float]]) -> float:
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
    """Coordinates along and behind a side of a wall."""

    def __init__(self, side: Side) -> None:
        self.side = side
        way = side.ends[1] - side.ends[0]
        self.length = float(np.linalg.norm(way))
        self.along = way / self.length
        self.back = np.array([self.along[1], -self.along[0]])

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
        return (first, last, depth) if opposite and 0 < depth < thickest and min(last, self.length) > first else None


def _open_spans(evidence: Evidence, frame: _Frame) -> list[Span]:
    """Return where views see through a side of a wall, in at least half of the layers of a window."""
    cell, height = evidence.extent.pixel, evidence.storey.height
    places = frame.side.ends[0] + (np.arange(int(frame.length / cell)) + 0.5)[:, None] * cell * frame.along
    free = _counts(evidence, evidence.free, places + 2 * cell * frame.back)
    hits = np.max([_counts(evidence, evidence.hits, places + step * cell * frame.back) for step in (-1, 0, 1)], axis=0)
    through = free > hits
    # Layers below window sills, and those of windows; both are open in doors.
    below, beside = slice(LAYERS // 16, LAYERS * 5 // 16), slice(LAYERS * 3 // 8, LAYERS * 3 // 4)
    low, high = (through[:, part].mean(axis=1) >= 0.5 for part in (below, beside))
    opened = np.flatnonzero(high)
    if not len(opened):
        return []
    parts = np.split(opened, np.flatnonzero(np.diff(opened) > 0.06 * height / cell + 1) + 1)
    return [
        (float(part[0] * cell), float((part[-1] + 1) * cell), bool(low[part].mean() > 0.5))
        for part in parts
        if (part[-1] + 1 - part[0]) * cell >= 0.2 * height
    ]


def _counts(evidence: Evidence, counts: NDArray[np.uint16], xy: FloatArray) -> NDArray[np.uint16]:
    index, inside = evidence.extent.cells(xy)
    return np.where(inside[:, None], counts[index], np.uint16(0))


def _joined(spans: list[Span], length: float) -> list[Span]:
    """Return spans within a length, in rising order, those that overlap as one."""
    result: list[Span] = []
    for start, end, low in sorted((max(start, 0.0), min(end, length), low) for start, end, low in spans):
        if end <= start:
            continue
        if result and start <= result[-1][1]:
            result[-1] = (result[-1][0], max(end, result[-1][1]), low or result[-1][2])
        else:
            result.append((start, end, low))
    return result
