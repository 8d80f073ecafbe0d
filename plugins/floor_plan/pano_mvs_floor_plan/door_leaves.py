"""Leaves of open doors: upright surfaces as long as their opening is wide, that start at one end of it and end free."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.points.plan_grid import Storey
from pano_mvs.core.arrays import FloatArray
from pano_mvs_floor_plan.evidence import PlanView
from pano_mvs_floor_plan.wall_lines import Line

_TURNS_DEG = np.arange(40.0, 131.0, 3.0)  # from closed; leaves along the wall cannot be told from it
_WIDEST = 0.5  # of the storey's height; what is wider has no single leaf
_HEIGHTS = 0.35, 0.75  # of the storey's height, above most furniture, between which leaves are looked for
_LEAST_SCORE = 0.5  # share of a leaf that must be seen, beyond what goes on behind its free end
# Distance beside a leaf, as a share of the storey's height, and the share of the places there that views see through.
_BEHIND, _LEAST_FREE = 0.06, 0.3
_ROWS, _COLUMNS = 6, 6


@dataclass(frozen=True, eq=False)
class DoorLeaf:
    """The leaf of a door: where it is hinged, (2,), and its free end when open, (2,), and when closed, (2,)."""

    hinge: FloatArray
    open_end: FloatArray
    closed_end: FloatArray

    @property
    def reach(self) -> FloatArray:
        """The corners (3, 2) of what it sweeps, about."""
        return np.array([self.hinge, self.open_end, self.open_end + self.closed_end - self.hinge])


def door_leaves(
    doors: Sequence[tuple[FloatArray, float]],
    *,
    views: Callable[[], Iterable[PlanView]],
    lines: Sequence[Line],
    storey: Storey,
    cell: float,
) -> list[DoorLeaf | None]:
    """Return the leaves of doors, None where none is seen that stands open.

    What goes on as a solid behind its face, such as the side of a wardrobe, is not a leaf: views must see through what
    is beside both faces.

    `doors`: ends (2, 2), in the middle of the wall, and the thickness of the wall, 0 if unknown. `views`: gives the
    views, and is called up to twice. `lines`: of the walls, whose surfaces are not leaves. `cell`: edge of a cell in
    which these were looked for.
    """
    low, high = (storey.floor + share * storey.height for share in _HEIGHTS)
    near: list[list[FloatArray]] = [[] for _ in doors]
    for view in views():
        if not len(view.points):
            continue
        with np.errstate(invalid="ignore"):
            upright = np.abs(view.normals[:, 2]) < 0.35
        kept = upright & (view.points[:, 2] > low) & (view.points[:, 2] < high)
        # Only what is near a door, as there may be many lines.
        around = [
            (np.abs(view.points[:, :2] - ends.mean(axis=0)) < _reach(ends, depth)).all(axis=1) for ends, depth in doors
        ]
        kept &= np.any(around, axis=0)
        points, normals = view.points[kept], view.normals[kept]
        is_free = np.ones(len(points), np.bool_)
        for line in lines if len(points) else ():
            on_wall = np.abs(points[:, :2] @ line.normal - line.offset) < 2 * cell
            is_free &= ~(on_wall & (np.abs(normals[:, :2] @ line.normal) > 0.9))
        columns = np.column_stack([points, normals[:, :2]])
        for parts, chosen in zip(near, around, strict=True):
            parts.append(columns[is_free & chosen[kept]])
    across = max(1.5 * cell, 0.02 * storey.height)
    widest = _WIDEST * storey.height
    found = [
        None
        if np.linalg.norm(ends[1] - ends[0]) > widest
        else _leaf(np.concatenate([np.zeros((0, 5)), *parts]), ends, depth=depth, heights=(low, high), across=across)
        for parts, (ends, depth) in zip(near, doors, strict=True)
    ]
    if not any(found):
        return found
    behind = {
        idx: _behind(leaf, heights=(low, high), away=_BEHIND * storey.height) for idx, leaf in enumerate(found) if leaf
    }
    seen = {idx: np.zeros(places.shape[:2], np.bool_) for idx, places in behind.items()}
    for view in views():
        for idx, places in behind.items():
            away, pixels = view.pixels_of(places)
            with np.errstate(invalid="ignore"):
                seen[idx] |= view.free[pixels] > away
    return [
        leaf if leaf is not None and seen[idx].mean(axis=1).min() > _LEAST_FREE else None
        for idx, leaf in enumerate(found)
    ]


def _reach(ends: FloatArray, depth: float) -> float:
    return 2.5 * float(np.linalg.norm(ends[1] - ends[0])) + depth


def _behind(leaf: DoorLeaf, *, heights: tuple[float, float], away: float) -> FloatArray:
    """Return places beside both faces of a leaf, (2, N, 3)."""
    way = leaf.open_end - leaf.hinge
    across = np.array([-way[1], way[0]]) / np.linalg.norm(way)
    share, height = np.meshgrid(np.linspace(0.3, 0.95, 10), np.linspace(*heights, 10))
    xy = leaf.hinge + share.reshape(-1, 1) * way
    return np.stack([np.column_stack([xy + side * away * across, height.reshape(-1)]) for side in (1, -1)])


def _leaf(
    points: FloatArray, ends: FloatArray, *, depth: float, heights: tuple[float, float], across: float
) -> DoorLeaf | None:
    """Return the leaf that points (N, 5) show, x, y, z and a normal's x and y."""
    width = float(np.linalg.norm(ends[1] - ends[0]))
    back = np.array([[0, 1], [-1, 0]]) @ (ends[1] - ends[0]) / width
    row = np.floor((points[:, 2] - heights[0]) / (heights[1] - heights[0]) * _ROWS).astype(np.int64).clip(0, _ROWS - 1)
    best, found = 0.0, None
    for first, last in (ends, ends[::-1]):
        closed = (last - first) / width
        for side in (1.0, -1.0):
            hinge = first + side * back * depth / 2
            for turn in np.deg2rad(_TURNS_DEG):
                along = np.cos(turn) * closed + np.sin(turn) * side * back
                way = points[:, :2] - hinge
                place = way @ along / width
                beside = np.where(
                    np.abs(points[:, 3:] @ along) < 0.5, np.abs(way @ np.array([-along[1], along[0]])), np.inf
                )
                on_leaf = beside < across
                # All of its length counts, and its free end, which a shallow cupboard does not reach.
                seen = min(_share(place, row, on_leaf, span) for span in ((0.1, 0.9), (0.6, 0.9)))
                score = seen - _share(place, row, beside < 3 * across, (1.15, 1.6))
                if score > best:
                    best, found = score, DoorLeaf(hinge, hinge + width * along, hinge + width * closed)
    return found if best > _LEAST_SCORE else None


def _share(place: FloatArray, row: NDArray[np.int64], on_leaf: NDArray[np.bool_], span: tuple[float, float]) -> float:
    """Return the share of the cells of a span that points on a leaf are in."""
    column = np.floor((place - span[0]) / (span[1] - span[0]) * _COLUMNS).astype(np.int64)
    chosen = on_leaf & (column >= 0) & (column < _COLUMNS)
    counts = np.bincount(row[chosen] * _COLUMNS + column[chosen], minlength=_ROWS * _COLUMNS)
    return float((counts >= 2).mean())
