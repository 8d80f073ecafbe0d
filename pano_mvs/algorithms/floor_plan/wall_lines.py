"""Wall lines of a floor plan: a Hough transform on the cells with vertical surfaces, then least squares.

Each cell supports the one line through it that its normal determines. The line with the most support takes its cells
and is fitted to them; then the rest are searched again. Both sides of a wall give a line each, because normals are on
the side that was seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from pano_mvs.algorithms.floor_plan.plan_grid import LAYERS, WallCells
from pano_mvs.core.arrays import FloatArray

_ANGLE_BINS = 180
# Cells belong to a line if they are this close, in cells, and their normals this similar.
_NEAR_CELLS = 1.5
_TAKEN_CELLS = 2.5
_MAX_TURN_DEG = 25.0
_CORNER_DEG = 20.0


@dataclass(frozen=True, eq=False)
class Walls:
    """Straight walls."""

    # (N, 2, 2) start and end of each; the side that was seen is on the left of the way from start to end
    ends_xy: FloatArray

    @property
    def lengths(self) -> FloatArray:
        """Lengths (N,)."""
        return np.asarray(np.linalg.norm(self.ends_xy[:, 1] - self.ends_xy[:, 0], axis=1))


@dataclass(frozen=True)
class _Line:
    """The line normal · x = offset."""

    normal: FloatArray
    offset: float

    @property
    def along(self) -> FloatArray:
        return np.array([self.normal[1], -self.normal[0]])


def wall_lines(cells: WallCells, *, min_share: float, min_length: float, max_gap: float, snap: float) -> Walls:
    """Return the straight walls among cells of a plan.

    `cells`: with vertical surfaces. `min_share`: least share of the height between floor and ceiling. `min_length`:
    shorter lines are left out. `max_gap`: gaps in a line up to this are closed. `snap`: ends are moved to the corner
    with another wall if it is at most this far away.
    """
    left = cells.only(cells.shares >= min_share)
    if not len(left.xy):
        return Walls(np.zeros((0, 2, 2)))
    origin = np.median(left.xy, axis=0)
    left = replace(left, xy=left.xy - origin)
    found: list[FloatArray] = []
    for _ in range(500):
        line, support = _strongest(left)
        if line is None or support < 0.25 * min_share * LAYERS * min_length / cells.cell:
            break
        line = _fitted(line, left)
        along = left.xy[_of_line(line, left, within=_NEAR_CELLS)] @ line.along
        pieces = _pieces(along, cell=cells.cell, max_gap=max_gap, min_length=min_length)
        found += [line.normal * line.offset + line.along * np.array(piece)[:, None] for piece in pieces]
        left = left.only(~_of_line(line, left, within=_TAKEN_CELLS))
    merged = _merged(found, near=_NEAR_CELLS * cells.cell, max_gap=max_gap)
    ends = _at_corners(_without_shadows(merged, near=max_gap / 2), snap=snap)
    return Walls(np.array(ends).reshape(-1, 2, 2) + origin)


def _strongest(cells: WallCells) -> tuple[_Line | None, float]:
    """Return the line with the most support, and how much that is."""
    if not len(cells.xy):
        return None, 0.0
    normals = cells.normals_xy
    angle = np.arctan2(normals[:, 1], normals[:, 0]) / (2 * np.pi) * _ANGLE_BINS
    offset = (cells.xy * normals).sum(axis=1) / cells.cell
    low = np.floor(offset.min()) - 2
    size = int(offset.max() - low) + 4
    index = (np.floor(angle).astype(np.int64) % _ANGLE_BINS) * size + np.floor(offset - low).astype(np.int64)
    support = np.bincount(index, cells.weights, _ANGLE_BINS * size).reshape(_ANGLE_BINS, size)
    smooth = gaussian_filter(support, (1.5, 1.0), mode=("wrap", "constant"), truncate=3)
    best = int(np.argmax(smooth))
    turn = (best // size + 0.5) * 2 * np.pi / _ANGLE_BINS
    normal = np.array([np.cos(turn), np.sin(turn)])
    # The smoothing spreads the support of one line over about 1.5 × 1 × 2π bins.
    return _Line(normal, (best % size + low + 0.5) * cells.cell), float(smooth.flat[best] * 1.5 * 2 * np.pi)


def _of_line(line: _Line, cells: WallCells, *, within: float) -> NDArray[np.bool_]:
    """Return which cells face the same side as a line, at a distance of at most `within` cells."""
    near = np.abs(cells.xy @ line.normal - line.offset) <= within * cells.cell
    return np.asarray(near & (cells.normals_xy @ line.normal >= np.cos(np.deg2rad(_MAX_TURN_DEG))))


def _fitted(line: _Line, cells: WallCells) -> _Line:
    """Return the weighted total least-squares line of the cells near a line."""
    for number in range(3):
        near = cells.only(_of_line(line, cells, within=_NEAR_CELLS if number else _TAKEN_CELLS))
        if len(near.xy) < 3:
            return line
        mean = np.average(near.xy, axis=0, weights=near.weights)
        spread = (near.xy - mean).T @ ((near.xy - mean) * near.weights[:, None])
        normal = np.linalg.eigh(spread)[1][:, 0]
        normal = normal if normal @ line.normal > 0 else -normal
        if normal @ line.normal < np.cos(np.deg2rad(_MAX_TURN_DEG)):
            return line
        line = _Line(normal, float(mean @ normal))
    return line


def _pieces(along: FloatArray, *, cell: float, max_gap: float, min_length: float) -> list[tuple[float, float]]:
    """Return start and end of the runs of positions along a line without large gaps."""
    if not len(along):
        return []
    ordered = np.sort(along)
    breaks = np.flatnonzero(np.diff(ordered) > max_gap)
    pieces = []
    for start, end in zip([0, *(breaks + 1)], [*breaks, len(ordered) - 1], strict=True):
        length = ordered[end] - ordered[start]
        filled = len(np.unique(np.floor((ordered[start : end + 1] - ordered[start]) / cell))) * cell
        if length >= min_length and filled >= 0.4 * length:
            # The mean position in the outermost cells is half a cell inside.
            pieces.append((float(ordered[start] - cell / 2), float(ordered[end] + cell / 2)))
    return pieces


def _merged(ends: list[FloatArray], *, near: float, max_gap: float) -> list[FloatArray]:
    """Return segments with collinear neighbours, which were fitted separately, joined."""
    joined: list[FloatArray] = []
    for segment in sorted(ends, key=lambda each: -float(np.linalg.norm(each[1] - each[0]))):
        for number, other in enumerate(joined):
            whole = _union(other, segment, near=near, max_gap=max_gap)
            if whole is not None:
                joined[number] = whole
                break
        else:
            joined.append(segment)
    return joined


def _union(first: FloatArray, second: FloatArray, *, near: float, max_gap: float) -> FloatArray | None:
    """Return the union of a long and a shorter segment on one line; None if they are not on one line."""
    length = float(np.linalg.norm(first[1] - first[0]))
    along = (first[1] - first[0]) / length
    direction = (second[1] - second[0]) / np.linalg.norm(second[1] - second[0])
    if along @ direction < np.cos(np.deg2rad(3.0)):
        return None
    offset = second - first[0]
    if np.abs(offset @ [along[1], -along[0]]).max() > near:
        return None
    start, end = offset @ along
    if start > length + max_gap or end < -max_gap:
        return None
    return np.asarray(first[0] + along * np.array([min(0.0, start), max(length, end)])[:, None])


def _without_shadows(ends: list[FloatArray], *, near: float) -> list[FloatArray]:
    """Return segments without those that lie beside a longer one, along all of it, with the same side seen."""
    kept: list[FloatArray] = []
    for segment in sorted(ends, key=lambda each: -float(np.linalg.norm(each[1] - each[0]))):
        direction = (segment[1] - segment[0]) / np.linalg.norm(segment[1] - segment[0])
        if not any(_shades(other, segment, direction, near=near) for other in kept):
            kept.append(segment)
    return kept


def _shades(longer: FloatArray, segment: FloatArray, direction: FloatArray, *, near: float) -> bool:
    length = float(np.linalg.norm(longer[1] - longer[0]))
    along = (longer[1] - longer[0]) / length
    offset = segment - longer[0]
    places = offset @ along
    beside = np.abs(offset @ [along[1], -along[0]]).max() <= near
    return bool(
        beside
        and places.min() >= -near
        and places.max() <= length + near
        and along @ direction >= np.cos(np.deg2rad(_CORNER_DEG))
    )


def _at_corners(ends: list[FloatArray], *, snap: float) -> list[FloatArray]:
    """Return segments whose ends are moved to the nearest corner with another segment."""
    moved = []
    for number, segment in enumerate(ends):
        length = float(np.linalg.norm(segment[1] - segment[0]))
        along = (segment[1] - segment[0]) / length
        corners = [
            place
            for other, rival in enumerate(ends)
            if other != number and (place := _corner(segment[0], along, rival, snap=snap)) is not None
        ]
        bounds = []
        for end in (0.0, length):
            close = [place for place in corners if abs(place - end) <= snap]
            bounds.append(min(close, key=lambda place, end=end: abs(place - end)) if close else end)  # type: ignore[misc]
        moved.append(segment[0] + along * np.array(bounds)[:, None])
    return moved


def _corner(start: FloatArray, along: FloatArray, other: FloatArray, *, snap: float) -> float | None:
    """Return where on a line another segment, lengthened by `snap`, crosses it; None if it does not."""
    length = float(np.linalg.norm(other[1] - other[0]))
    direction = (other[1] - other[0]) / length
    cross = float(along[0] * direction[1] - along[1] * direction[0])
    if abs(cross) < np.sin(np.deg2rad(_CORNER_DEG)):
        return None
    offset = other[0] - start
    place = float(offset[0] * direction[1] - offset[1] * direction[0]) / cross
    on_other = float(offset[0] * along[1] - offset[1] * along[0]) / cross
    return place if -snap <= on_other <= length + snap else None
