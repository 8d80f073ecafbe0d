"""Clouds and ranges of rooms with known walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, ray_grid, rotation_from_rotvec
from pano_mvs.scene import PointCloud, Poses, RangeMap, WorldAxes
from pano_mvs.scene.upright import z_up_from_world

WORLD_FROM_Z_UP = z_up_from_world().T

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


def distance_to(walls: FloatArray, xy: FloatArray) -> FloatArray:
    """Return the distance of each position (N, 2) from the nearest of the walls (M, 2, 2)."""
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    share = np.einsum("nmk,mk->nm", xy[:, None] - start, along) / (along**2).sum(axis=1)
    nearest = start + np.clip(share, 0, 1)[..., None] * along
    return np.asarray(np.linalg.norm(xy[:, None] - nearest, axis=-1).min(axis=1))


def samples(walls: FloatArray) -> FloatArray:
    """Return 50 positions on each wall."""
    return np.concatenate([start + np.linspace(0, 1, 50)[:, None] * (end - start) for start, end in walls])


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


def the_cloud(*rooms: RoomCloud) -> PointCloud:
    """Return the cloud of rooms, which three images have seen."""
    points = np.concatenate([room.points for room in rooms])
    normals = np.concatenate([room.normals for room in rooms])
    return PointCloud(
        (points @ WORLD_FROM_Z_UP.T).astype(np.float32),
        (normals @ WORLD_FROM_Z_UP.T).astype(np.float32),
        np.concatenate([room.colors for room in rooms]),
        np.full(len(points), 3, np.uint8),
    )


def the_poses(*centers: tuple[float, float, float], metric: bool = True) -> Poses:
    """Return level cameras at positions with z up."""
    cameras = {}
    for idx, center in enumerate(centers):
        rotation = rotation_from_rotvec([0, 0.5 * idx, 0])
        cameras[f"{idx}.jpg"] = Rigid3(rotation, -rotation @ WORLD_FROM_Z_UP @ np.array(center))
    return Poses.without_points(cameras, frame="", scale="", metric=metric, axes=WorldAxes.LEVEL)


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


FLAT = (
    ((0.0, 0.0), (4.0, 3.0)),
    ((4.2, 0.0), (7.2, 3.0)),
)
"""Two rooms beside each other, lower left and upper right corners, with a wall of 0.2 between them."""

DOOR = (1.8, 2.7)
"""Where the wall between the two rooms has a door of 2 m."""

WINDOW = (1.0, 2.5)
"""Where the lower wall of the first room has a window, from 1 m to 2 m, with a wall of a house 3 m behind it."""


Panel = tuple[FloatArray, FloatArray, float, float]
"""An upright surface: the positions of its ends, its lower and its upper edge."""


def flat_ranges(
    cam_from_world: Rigid3, *, turn: FloatArray, size_hw: tuple[int, int] = (128, 256), more: Sequence[Panel] = ()
) -> RangeMap:
    """Return the exact range map of a camera in the two rooms, turned by `turn`, (2, 2), about the origin; z up.

    `more`: further surfaces in the rooms.
    """
    (west, east), height = FLAT, HEIGHT
    panels = [(start, end, 0.0, height) for low, high in FLAT for start, end in walls_of(_rectangle(low, high))]
    keep = [*(one for one in panels if not _crosses(one)), *more]
    for x in (west[1][0], east[0][0]):
        keep += [(np.array([x, 0.0]), np.array([x, DOOR[0]]), 0.0, height)]
        keep += [(np.array([x, DOOR[1]]), np.array([x, 3.0]), 0.0, height)]
        keep += [(np.array([x, DOOR[0]]), np.array([x, DOOR[1]]), 2.0, height)]
    for y in DOOR:
        keep += [(np.array([west[1][0], y]), np.array([east[0][0], y]), 0.0, height)]
    start, end = np.array([WINDOW[0], 0.0]), np.array([WINDOW[1], 0.0])
    keep += [(np.zeros(2), start, 0.0, height), (end, np.array([4.0, 0.0]), 0.0, height)]
    keep += [(start, end, 0.0, 1.0), (start, end, 2.0, height)]
    keep += [(np.array([-9.0, -3.0]), np.array([9.0, -3.0]), 0.0, height)]
    rays, center = ray_grid(size_hw) @ cam_from_world.rotation, cam_from_world.center
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = np.where(rays[..., 2] < 0, -center[2] / rays[..., 2], (height - center[2]) / rays[..., 2])
        for first, last, low, high in keep:
            (x, y), edge = turn @ first - center[:2], turn @ (last - first)
            slope = rays[..., 0] * edge[1] - rays[..., 1] * edge[0]
            distance = (x * edge[1] - y * edge[0]) / slope
            share = (x * rays[..., 1] - y * rays[..., 0]) / slope
            level = center[2] + distance * rays[..., 2]
            hit = (distance > 0) & (share >= 0) & (share <= 1) & (level >= low) & (level <= high)
            ranges = np.where(hit & (distance < ranges), distance, ranges)
    return RangeMap(
        ranges.astype(np.float32), np.full(size_hw, 200, np.uint8), uncertainty=np.full(size_hw, 0.003, np.float16)
    )


def _rectangle(low: tuple[float, float], high: tuple[float, float]) -> tuple[tuple[float, float], ...]:
    return (low, (high[0], low[1]), high, (low[0], high[1]))


def _crosses(panel: Panel) -> bool:
    """Return whether a wall has the door or the window."""
    x, y = (panel[0] + panel[1]) / 2
    return x in (4.0, 4.2) or (y == 0.0 and x < 4.0)
