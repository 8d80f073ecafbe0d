"""A house whose rooms see each other through doors only, with plain walls and two or three panoramas in each room.

With `twins`, the furniture of the last room repeats that of the first one, as a trap: the two rooms share no wall.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, rotation_from_quat_wxyz, rotation_from_rotvec
from pano_mvs.testing.room import Room, render
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad
from tests.synthetic.paints import BLUE, BRICK, LEAVES, OAK, RED, STEEL, STONE, WHITE
from tests.synthetic.rod import Rod
from tools.benchmarks.poses.painted import Paint, Painted, bounded, write_views

# Cells of the plan (column, row), in the order of a walk, and the pairs of rooms with a door between them.
CELLS = ((0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1))
DOORS = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5))
_LONG, _WIDE, _CEILING, _FLOOR = 4.6, 4.0, -1.25, 1.4
_HALF_DOOR, _LINTEL, _HALF_WALL = 0.45, -0.65, 0.06
_COLORS = (OAK, BRICK, LEAVES, STEEL, BLUE, RED, STONE)
_NOISE, _TILT_DEG = 1.5, 1.0

Thing = Ball | Cuboid | Quad | Rod


@dataclass(frozen=True)
class House:
    """A house and its cameras.

    Attributes:
        seed: of furniture, textures and cameras.
        per_room: number of panoramas in each room.
        twins: whether the last room has the furniture of the first one.
        turned: whether every camera is rotated arbitrarily; otherwise it has any heading and a tilt of about a degree.
        rooms: number of rooms, at most six.
    """

    seed: int = 0
    per_room: int = 2
    twins: bool = False
    turned: bool = False
    rooms: int = 6

    def room_of(self, view: int) -> int:
        """Return the room in which a view was taken."""
        return view // self.per_room

    def poses(self) -> list[Rigid3]:
        """Return cam_from_world of all views, room by room."""
        rng = np.random.default_rng([self.seed, 0xCA])
        found = []
        for room in range(self.rooms):
            x, z = _middle(room)
            start = rng.uniform(0, 2 * np.pi)
            for number in range(self.per_room):
                angle = start + 2 * np.pi * number / self.per_room + rng.uniform(-0.3, 0.3)
                away = rng.uniform(0.55, 0.85)
                place = (x + away * np.cos(angle), rng.uniform(-0.04, 0.04), z + away * np.sin(angle))
                tilt = np.deg2rad(_TILT_DEG) * rng.normal(size=3) * (1, 0, 1)
                heading = rotation_from_rotvec((0.0, rng.uniform(-np.pi, np.pi), 0.0))
                upright = rotation_from_rotvec(tilt) @ heading
                anyhow = rotation_from_quat_wxyz(rng.normal(size=4))
                found.append(Rigid3.from_center(anyhow if self.turned else upright, np.array(place)))
        return found

    def view(self, idx: int, size_hw: tuple[int, int]) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) uint8 RGB of a view, with noise and an exposure of its own."""
        pose, here = self.poses()[idx], self.room_of(idx)
        x, z = _middle(here)
        painted = [thing for room in range(self.rooms) for thing in self._room(room)]
        painted += [thing for pair in _walls(self.rooms) for thing in _wall(*pair, seed=self.seed)]
        place = Room(
            tuple(surface for surface, _ in painted),
            lamp=(x + 0.3, -1.1, z - 0.2),
            textures=tuple(paint for _, paint in painted),
        )
        image, _ = render(place, pose, size_hw, supersample=1)
        rng = np.random.default_rng([self.seed, idx])
        levels = image * rng.uniform(0.92, 1.04) + rng.normal(0, _NOISE, image.shape)
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8)

    def _room(self, room: int) -> Iterator[Painted]:
        """Yield the floor and the ceiling of a room, its furniture along the walls, and what hangs on these."""
        like = 0 if self.twins and room == self.rooms - 1 else room
        rng = np.random.default_rng([self.seed, like])
        (x, z), origin = _middle(room), (_middle(room)[0], 0.0, _middle(room)[1])
        floor = Quad((x - _LONG / 2, _FLOOR, z - _WIDE / 2), (_LONG, 0, 0), (0, 0, _WIDE), OAK)
        yield floor, Paint(_COLORS[like % 3], self.seed + 100 * like + 90, origin, plain=True)
        ceiling = Quad((x - _LONG / 2, _CEILING, z - _WIDE / 2), (_LONG, 0, 0), (0, 0, _WIDE), WHITE)
        yield ceiling, Paint(WHITE, self.seed + 100 * like + 91, origin, plain=True)
        for number, thing in enumerate(_furniture(rng, x, z)):
            colors = _COLORS[int(rng.integers(len(_COLORS)))]
            surface = thing if isinstance(thing, Quad) else bounded(thing)
            yield surface, Paint(colors, self.seed + 100 * like + number, origin)


def write_house(folder: Path, house: House, *, width: int) -> dict[str, Rigid3]:
    """Render the pictures that a folder does not have yet, and return the true cam_from_world of all, by name."""
    truth = {f"{house.room_of(idx)}-{idx:02d}.png": pose for idx, pose in enumerate(house.poses())}
    return write_views(folder, truth, lambda idx, _: house.view(idx, (width // 2, width)))


def _middle(room: int) -> tuple[float, float]:
    column, row = CELLS[room]
    return (column + 0.5) * _LONG, (row + 0.5) * _WIDE


def _walls(rooms: int) -> Iterator[tuple[tuple[int, int], tuple[int, int], bool]]:
    """Yield the walls around all rooms: the cells on both sides, and whether there is a door."""
    cells, doors = CELLS[:rooms], {frozenset((CELLS[a], CELLS[b])) for a, b in DOORS if max(a, b) < rooms}
    seen: set[frozenset[tuple[int, int]]] = set()
    for column, row in cells:
        for other in ((column - 1, row), (column + 1, row), (column, row - 1), (column, row + 1)):
            sides = frozenset(((column, row), other))
            if sides not in seen:
                seen.add(sides)
                first, second = sorted(sides)
                yield first, second, sides in doors


def _wall(first: tuple[int, int], second: tuple[int, int], door: bool, *, seed: int) -> Iterator[Painted]:
    """Yield the parts of a wall: both sides of its door, if it has one, and the lintel."""
    along_x = first[0] == second[0]
    length, at = (_LONG, second[1] * _WIDE) if along_x else (_WIDE, second[0] * _LONG)
    start = first[0] * _LONG if along_x else first[1] * _WIDE
    middle = start + length * (0.28 if sum(first) % 2 else 0.7)
    parts = [(start, start + length, _CEILING, _FLOOR)]
    if door:
        low, high = middle - _HALF_DOOR, middle + _HALF_DOOR
        parts = [
            (start, low, _CEILING, _FLOOR),
            (high, start + length, _CEILING, _FLOOR),
            (low, high, _CEILING, _LINTEL),
        ]
    for left, right, top, bottom in parts:
        low_xz, high_xz = (left, at - _HALF_WALL), (right, at + _HALF_WALL)
        if not along_x:
            low_xz, high_xz = low_xz[::-1], high_xz[::-1]
        cuboid = Cuboid((low_xz[0], top, low_xz[1]), (high_xz[0], bottom, high_xz[1]), WHITE)
        number = 7 * (first[0] + 4 * first[1]) + (3 if along_x else 0) + 5000
        yield bounded(cuboid), Paint(WHITE, seed + number, (0.0, 0.0, 0.0), plain=True)


def _furniture(rng: np.random.Generator, x: float, z: float) -> Iterator[Thing]:
    """Yield cupboards, pictures, balls and hanging lamps along the walls of a room with the middle (x, z)."""
    for side_x, side_z in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        for along in (0, 1):
            far = rng.uniform(0.55, 0.8)
            shift = (side_x * far * _LONG / 2, side_z * 0.86 * _WIDE / 2)
            if along:
                shift = (side_x * 0.86 * _LONG / 2, side_z * far * _WIDE / 2)
            half = rng.uniform(0.15, 0.32, 2)
            top = float(rng.uniform(-0.3, 1.0))
            cx, cz = x + shift[0] * 0.92, z + shift[1] * 0.92
            yield Cuboid((cx - half[0], top, cz - half[1]), (cx + half[0], _FLOOR, cz + half[1]), OAK)
            yield Ball((cx, top - 0.12, cz), float(rng.uniform(0.08, 0.14)), OAK)
        end = (x + side_x * 0.9, float(rng.uniform(-1.0, -0.75)), z + side_z * 0.7)
        yield Rod((end[0], _CEILING, end[2]), end, 0.04, OAK)
    for side in (-1, 1):
        wide, high = rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.7)
        corner = (x - wide / 2, float(rng.uniform(-0.8, -0.5)), z + side * (_WIDE / 2 - _HALF_WALL - 0.01))
        yield Quad(corner, (float(wide), 0.0, 0.0), (0.0, float(high), 0.0), OAK)
