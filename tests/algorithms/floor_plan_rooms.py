"""Clouds of rooms with known walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray

HEIGHT = 2.6

L_SHAPE = ((0.0, 0.0), (6.0, 0.0), (6.0, 3.0), (3.5, 3.0), (3.5, 5.0), (0.0, 5.0))
"""The corners of an L-shaped room, counter-clockwise."""


@dataclass(frozen=True)
class RoomCloud:
    """Points (N, 3) with z up, their normals (N, 3) into the room, and colours (N, 3)."""

    points: FloatArray
    normals: FloatArray
    colors: NDArray[np.uint8]


def walls_of(corners: Sequence[tuple[float, float]]) -> FloatArray:
    """Return the ends of the walls, (N, 2, 2), with the inside on the left."""
    ends = np.array(corners)
    return np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)


def room_cloud(
    corners: Sequence[tuple[float, float]] = L_SHAPE,
    *,
    floor: float = 0.0,
    density: float = 600.0,
    noise: float = 0.01,
    door: tuple[int, float, float] | None = None,
    table: bool = True,
    seed: int = 0,
) -> RoomCloud:
    """Return the cloud of a room.

    Args:
        corners: of its plan, counter-clockwise.
        floor: its height.
        density: points per unit of area.
        noise: standard deviation of the points.
        door: number of a wall, with the start and the end of a gap in it.
        table: whether a table stands in it, 0.75 high.
    """
    rng = np.random.default_rng(seed)
    parts: list[tuple[FloatArray, FloatArray, tuple[int, int, int]]] = []
    for number, (start, end) in enumerate(walls_of(corners)):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        place = rng.uniform(0, length, int(length * HEIGHT * density))
        if door is not None and door[0] == number:
            place = place[(place < door[1]) | (place > door[2])]
        height = rng.uniform(0, HEIGHT, len(place))
        points = np.column_stack([start + place[:, None] * along, floor + height])
        parts.append((points, np.tile([-along[1], along[0], 0.0], (len(points), 1)), (180, 60, 60)))
    inside = _inside(corners, rng, density)
    for level, up, color in ((0.0, 1.0, (90, 120, 90)), (HEIGHT, -1.0, (220, 220, 220))):
        points = np.column_stack([inside, np.full(len(inside), floor + level)])
        parts.append((points, np.tile([0.0, 0, up], (len(points), 1)), color))
    if table:
        count = int(5 * density)
        top = np.column_stack([rng.uniform((1, 1), (2.2, 1.8), (count, 2)), np.full(count, floor + 0.75)])
        parts.append((top, np.tile([0.0, 0, 1.0], (count, 1)), (30, 30, 220)))
    points = np.concatenate([each for each, _, _ in parts])
    normals = np.concatenate([each for _, each, _ in parts])
    colors = np.concatenate([np.tile(np.array(color, np.uint8), (len(each), 1)) for each, _, color in parts])
    return RoomCloud(points + rng.normal(scale=noise, size=points.shape), normals, colors)


def _inside(corners: Sequence[tuple[float, float]], rng: np.random.Generator, density: float) -> FloatArray:
    """Return random points inside a polygon, by the even-odd rule."""
    ends = np.array(corners)
    low, high = ends.min(axis=0), ends.max(axis=0)
    xy = rng.uniform(low, high, (int(np.prod(high - low) * density), 2))
    odd = np.zeros(len(xy), np.bool_)
    for (x0, y0), (x1, y1) in walls_of(corners).tolist():
        if y0 == y1:
            continue
        crosses = (xy[:, 1] < y0) != (xy[:, 1] < y1)
        odd ^= crosses & (xy[:, 0] < x0 + (xy[:, 1] - y0) * (x1 - x0) / (y1 - y0))
    return xy[odd]
