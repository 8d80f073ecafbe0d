"""A suite of furnished rooms, as long as a capture needs, in which nothing repeats; cheap enough for 300 views."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, rotation_from_quat_wxyz
from pano_mvs.testing.room import Room, render
from pano_mvs.testing.surfaces import Ball, Cuboid
from tests.synthetic.paints import BLUE, BRICK, LEAVES, OAK, RED, STEEL, STONE
from tests.synthetic.rod import Rod
from tools.benchmarks.poses.painted import Paint, Painted, bounded, write_views

VIEWS_PER_ROOM = 10
_LONG, _HALF_WIDE, _CEILING, _FLOOR = 6.0, 2.5, -1.3, 1.4
_HALF_DOOR, _LINTEL = 0.6, -0.7
# The doors lie left and right in turns, so that a room is seen from its neighbours but hardly from beyond them.
_DOOR_AT = 1.3
_COLORS = (OAK, BRICK, LEAVES, STEEL, BLUE, RED)
_NOISE = 1.0


def suite_poses(views: int, *, seed: int = 0) -> list[Rigid3]:
    """Return cameras that walk to and fro through the rooms, ten in each, about 0.7 apart and turned at random."""
    rng = np.random.default_rng([seed, 0xCA])
    x = (np.arange(views) + 0.5) * _LONG / VIEWS_PER_ROOM
    doors = np.arange(-(-views // VIEWS_PER_ROOM) + 1)
    z = np.interp(x, _LONG * doors, [_door_at(int(door)) for door in doors])
    centers = np.stack([x, np.zeros(views), z], axis=1) + rng.uniform(-0.12, 0.12, (views, 3))
    return [Rigid3.from_center(rotation_from_quat_wxyz(rng.normal(size=4)), center) for center in centers]


def suite_view(pose: Rigid3, size_hw: tuple[int, int], *, views: int, seed: int = 0) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) uint8 RGB that a camera sees, with sensor noise.

    Args:
        pose: cam_from_world.
        size_hw: of the picture.
        views: of the capture, which say how many rooms there are.
        seed: of the place.
    """
    rooms = -(-views // VIEWS_PER_ROOM)
    here = int(pose.center[0] // _LONG)
    shell = Cuboid((-0.01, _CEILING, -_HALF_WIDE), (rooms * _LONG + 0.01, _FLOOR, _HALF_WIDE), STONE)
    painted: list[Painted] = [(shell, Paint(STONE, seed))]
    for room in range(max(0, here - 2), min(rooms, here + 3)):
        painted += [*_partition(room, seed), *_furniture(room, seed)] if room else _furniture(room, seed)
    room_now = Room(
        tuple(surface for surface, _ in painted),
        lamp=(float(_LONG * here + 3.0), -1.2, 0.2),
        textures=tuple(paint for _, paint in painted),
    )
    image, _ = render(room_now, pose, size_hw, supersample=1)
    rng = np.random.default_rng([seed, *np.abs(1e6 * pose.center).astype(int)])
    return np.clip(np.rint(image + rng.normal(0, _NOISE, image.shape)), 0, 255).astype(np.uint8)


def write_suite(folder: Path, views: int, *, width: int, seed: int = 0) -> dict[str, Rigid3]:
    """Render the pictures that a folder does not have yet, and return the true cam_from_world of all, by name."""
    truth = {f"{idx:03d}.png": pose for idx, pose in enumerate(suite_poses(views, seed=seed))}
    return write_views(folder, truth, lambda _, pose: suite_view(pose, (width // 2, width), views=views, seed=seed))


def _door_at(door: int) -> float:
    return _DOOR_AT if door % 2 else -_DOOR_AT


def _partition(room: int, seed: int) -> Iterator[Painted]:
    """Yield the wall before a room: both sides of its door, and the lintel."""
    x, low, high = room * _LONG, _door_at(room) - _HALF_DOOR, _door_at(room) + _HALF_DOOR
    for part, (top, bottom, left, right) in enumerate(
        (
            (_CEILING, _FLOOR, -_HALF_WIDE, low),
            (_CEILING, _FLOOR, high, _HALF_WIDE),
            (_CEILING, _LINTEL, low, high),
        )
    ):
        paint = Paint(_COLORS[room % len(_COLORS)], seed + 100 * room + 50 + part)
        yield bounded(Cuboid((x - 0.06, top, left), (x + 0.06, bottom, right), paint.colors)), paint


def _furniture(room: int, seed: int) -> Iterator[Painted]:
    """Yield cupboards and chests along both walls, with things on them, and lamps that hang from the ceiling."""
    rng = np.random.default_rng([seed, room])
    for number, (side, place) in enumerate((side, place) for side in (-1, 1) for place in (0.8, 2.6, 4.4)):
        x = room * _LONG + place + rng.uniform(-0.2, 0.2)
        wide, deep, top = rng.uniform(0.5, 1.3), rng.uniform(0.25, 0.45), rng.uniform(-0.9, 1.0)
        near, far = sorted((side * _HALF_WIDE, side * (_HALF_WIDE - deep)))
        middle = (x + 0.5 * wide, top - 0.15, 0.5 * (near + far))
        colors = [_COLORS[int(rng.integers(len(_COLORS)))] for _ in range(3)]
        hung = (x, _CEILING, side * 0.5), (x, float(rng.uniform(-1.1, -0.8)), side * 0.5)
        things: tuple[Ball | Cuboid | Rod, ...] = (
            Cuboid((x, top, near), (x + wide, _FLOOR, far), colors[0]),
            Ball(middle, 0.15, colors[1]),
            Rod(*hung, 0.05, colors[2]),
        )
        for part, thing in enumerate(things):
            yield bounded(thing), Paint(colors[part], seed + 100 * room + 3 * number + part + 1)
