"""A walk through a house with two corridors and rooms between and beside them, whose path crosses itself several times.

The first 75 of 300 views close one loop, the first 150 a second one, and all 300 close four and walk one stretch twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.testing.room import Colors, Room, render
from pano_mvs.testing.surfaces import Ball, Cuboid, Surface, Vector
from tests.synthetic.bounded import Bounded
from tests.synthetic.paints import BLUE, BRICK, LEAVES, OAK, RED, STEEL, STONE
from tools.benchmarks.poses.painted import Paint, bounded, write_views

STEP = 0.6
_VIEWS = 300
_COLUMNS, _WIDE = 13, 4.0
_CEILING, _FLOOR, _LINTEL = -1.3, 1.4, -0.8
_HALF_DOOR, _HALF_WALL = 0.5, 0.06
# Rooms, the first corridor, rooms, and the second corridor lie between these lines.
_LINES = (-6.0, -1.0, 1.0, 6.0, 8.0)
_CROSSINGS = (0, 3, 6, 9, 12)
_COLORS = (OAK, BRICK, LEAVES, STEEL, BLUE, RED)
_SEEN_FROM = 25.0
_TWINS = {6: 3, 7: 4}
"""Columns whose rooms and corridors look like those of other columns in a house with twins."""
# Column and line of the corners of the path: 0 is the first corridor, 7 the second, −3.5 a room beside the first.
_CORNERS = (
    *((3, 0.0), (3, -3.5), (2, -3.5), (2, 0.0), (0, 0.0), (0, 7.0), (3, 7.0), (3, 0.0)),
    *((6, 0.0), (6, 7.0), (3, 7.0), (6, 7.0), (9, 7.0), (9, 0.0), (9, -3.5), (8, -3.5), (8, 0.0)),
    *((6, 0.0), (9, 0.0), (12, 0.0), (12, 7.0), (9, 7.0), (9, 0.0), (11, 0.0)),
)


Painted = tuple[Bounded, Paint]


def walk_poses(views: int, *, seed: int = 0) -> list[Rigid3]:
    """Return the first cameras of the walk, 0.6 apart, looking ahead with some swaying; at most 300."""
    if views > _VIEWS:
        raise ValueError(f"the walk has {_VIEWS} views, not {views}")
    rng = np.random.default_rng([seed, 0x3A])
    corners = np.array([(_middle(column), line) for column, line in _CORNERS])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(_VIEWS) * STEP
    flat = np.stack([np.interp(at, along, axis) for axis in corners.T], axis=1)
    ahead = np.stack([np.interp(at + 0.3, along, axis) for axis in corners.T], axis=1) - flat
    yaws = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1])) + rng.normal(0, 0.2, _VIEWS)
    centers = np.stack([flat[:, 0], np.zeros(_VIEWS), flat[:, 1]], axis=1) + rng.uniform(-0.1, 0.1, (_VIEWS, 3))
    tilts = rng.normal(0, np.radians(4), (_VIEWS, 3))
    return [
        Rigid3.from_center(rotation_from_rotvec(tilt) @ rotation_from_rotvec((0.0, -yaw, 0.0)), center)
        for tilt, yaw, center in zip(tilts[:views], yaws[:views], centers[:views], strict=True)
    ]


def walk_view(pose: Rigid3, size_hw: tuple[int, int], *, twins: bool = False, seed: int = 0) -> NDArray[np.uint8]:
    """Return the image (H, W, 3) uint8 RGB of a camera, with sensor noise."""
    center = pose.center
    near = [part for part in _house(twins, seed) if np.linalg.norm(np.array(part[0].center) - center) < _SEEN_FROM]
    shell = Cuboid((0.0, _CEILING, _LINES[0]), (_COLUMNS * _WIDE, _FLOOR, _LINES[-1]), STONE)
    surfaces: tuple[Surface, ...] = (shell, *(surface for surface, _ in near))
    lamp = (float(center[0] // _WIDE * _WIDE + 2), -1.2, float(center[2]) * 0.5)
    room = Room(surfaces, lamp=lamp, textures=(Paint(STONE, seed), *(paint for _, paint in near)))
    image, _ = render(room, pose, size_hw, supersample=1)
    rng = np.random.default_rng([seed, *np.abs(1e6 * center).astype(int)])
    return np.clip(np.rint(image + rng.normal(0, 1.0, image.shape)), 0, 255).astype(np.uint8)


def write_walk(folder: Path, views: int, *, width: int, twins: bool = False, seed: int = 0) -> dict[str, Rigid3]:
    """Render the images that a folder does not have yet, and return the true cam_from_world of all, by name."""
    truth = {f"{idx:03d}.png": pose for idx, pose in enumerate(walk_poses(views, seed=seed))}
    return write_views(folder, truth, lambda _, pose: walk_view(pose, (width // 2, width), twins=twins, seed=seed))


def _middle(column: int) -> float:
    return _WIDE * (column + 0.5)


@cache
def _house(twins: bool, seed: int) -> tuple[Painted, ...]:
    """Return the walls and the furniture of all columns."""
    parts: list[Painted] = []
    for column in range(_COLUMNS):
        like = _TWINS.get(column, column) if twins else column
        shift = _WIDE * (column - like)
        paint_seed = 1000 * seed + 100 * like
        parts += _walls(column, shift, paint_seed, like=like)
        parts += _furniture(column, shift, paint_seed, rng=np.random.default_rng([seed, like, 0xF0]))
        if twins and (column in _TWINS or column in _TWINS.values()):
            parts += _carpets(column, shift, paint_seed)
    return tuple(parts)


def _carpets(column: int, shift: float, seed: int) -> Iterator[Painted]:
    """Yield floors, ceilings and outer walls of a column, so that twins have nothing of their own."""
    left, right = _WIDE * column, _WIDE * (column + 1)
    front, back = _LINES[0], _LINES[-1]
    boxes: list[tuple[Vector, Vector]] = [
        ((left, _CEILING, front), (right, _CEILING + 0.01, back)),
        ((left, _FLOOR - 0.01, front), (right, _FLOOR, back)),
        ((left, _CEILING, front), (right, _FLOOR, front + 0.01)),
        ((left, _CEILING, back - 0.01), (right, _FLOOR, back)),
    ]
    for number, (low, high) in enumerate(boxes):
        yield _painted(low, high, STONE, seed + 90 + number, shift=shift)


def _walls(column: int, shift: float, seed: int, *, like: int) -> Iterator[Painted]:
    """Yield the walls of a column beside the corridors, and those on its left between rooms."""
    left, right, door = _WIDE * column, _WIDE * (column + 1), _middle(column)
    doors = (True, column in _CROSSINGS, column in _CROSSINGS)
    number = 0
    for z, open_here in zip(_LINES[1:-1], doors, strict=True):
        pieces = (
            [(left, door - _HALF_DOOR, _CEILING), (door + _HALF_DOOR, right, _CEILING)]
            if open_here
            else [(left, right, _CEILING)]
        )
        boxes = [((x0, top, z - _HALF_WALL), (x1, _FLOOR, z + _HALF_WALL)) for x0, x1, top in pieces]
        if open_here:
            lintel = (door - _HALF_DOOR, _CEILING, z - _HALF_WALL), (door + _HALF_DOOR, _LINTEL, z + _HALF_WALL)
            boxes.append(lintel)
        for low, high in boxes:
            number += 1
            yield _painted(low, high, _COLORS[(like + number) % len(_COLORS)], seed + number, shift=shift)
    beside = [(_LINES[2], _LINES[3])] + ([(_LINES[0], _LINES[1])] if column % 2 == 0 else [])
    for z0, z1 in beside if column else []:
        number += 1
        low, high = (left - _HALF_WALL, _CEILING, z0), (left + _HALF_WALL, _FLOOR, z1)
        yield _painted(low, high, _COLORS[(like + number) % len(_COLORS)], seed + number, shift=shift)


def _furniture(column: int, shift: float, seed: int, *, rng: np.random.Generator) -> Iterator[Painted]:
    """Yield chests in the rooms, and pictures and lamps in the corridors."""
    left = _WIDE * column
    places = ((_LINES[0] + 0.3, 0.4), (_LINES[0] + 2.6, 3.0), (_LINES[2] + 1.0, 0.4), (_LINES[2] + 3.5, 3.0))
    for number, (z, x) in enumerate(places):
        wide, deep, top = rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.7), rng.uniform(-0.6, 0.9)
        x0, z0 = left + x + rng.uniform(-0.2, 0.1), z + rng.uniform(-0.2, 0.2)
        colors = _COLORS[int(rng.integers(len(_COLORS)))]
        yield _painted((x0, top, z0), (x0 + wide, _FLOOR, z0 + deep), colors, seed + 40 + number, shift=shift)
        ball = Ball((x0 + 0.5 * wide, top - 0.15, z0 + 0.5 * deep), 0.15, colors)
        yield Bounded(ball, ball.center, 0.16), Paint(colors, seed + 60 + number, (shift, 0.0, 0.0))
    for number, z in enumerate((_LINES[1] + 0.1, _LINES[2] - 0.16, _LINES[3] + 0.1, _LINES[4] - 0.08)):
        x0 = left + rng.uniform(0.2, 0.8) + (0 if number % 2 else 2.2)
        top, wide = rng.uniform(-0.8, -0.2), rng.uniform(0.4, 0.8)
        colors = _COLORS[int(rng.integers(len(_COLORS)))]
        low, high = (x0, top, z), (x0 + wide, top + rng.uniform(0.5, 1.2), z + 0.06)
        yield _painted(low, high, colors, seed + 80 + number, shift=shift)


def _painted(low: Vector, high: Vector, colors: Colors, seed: int, *, shift: float) -> Painted:
    """Return a box within its bounding sphere, with its paint."""
    return bounded(Cuboid(low, high, colors)), Paint(colors, seed, (shift, 0.0, 0.0))
