"""Building blocks of the repeating places: walls, blocks, columns, and unique objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.testing.room import Colors, Pattern, Texture
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Surface, Vector
from tests.synthetic.bounded import Bounded
from tests.synthetic.paints import BLUE, BRICK, LEAVES, OAK, RED, STEEL, STONE, WHITE
from tests.synthetic.rod import Rod
from tools.benchmarks.repeating.drawings import Drawing, Kind
from tools.benchmarks.repeating.prints import Print
from tools.benchmarks.repeating.walks import Rect

Painted: TypeAlias = tuple[Surface, Texture | Pattern]

_PAINTS: tuple[Colors, ...] = (OAK, BRICK, STONE, STEEL, BLUE, RED, LEAVES)
# Length of wall for one picture and one piece of furniture.
_SLOT = 1.35


@dataclass(frozen=True)
class Wall:
    """A section of upright wall for pictures and furniture.

    Attributes:
        foot: its end at the floor, on the left when facing it.
        along: unit vector to its other end.
        length: length of the wall.
        height: height of the wall.
    """

    foot: Vector
    along: Vector
    length: float
    height: float

    def at(self, along: float, up: float, out: float) -> Vector:
        """Return the point at given distances along the wall, above the floor, and from the wall into the room."""
        # Facing the wall, its foot is on the left and the room behind.
        inward = np.array([self.along[2], 0.0, -self.along[0]])
        return vector(np.array(self.foot) + along * np.array(self.along) + out * inward - (0.0, up, 0.0))


@dataclass
class Site:
    """A place under construction.

    Attributes:
        painted: surfaces that have been built, with textures.
        walls: walls for pictures and furniture.
        obstacles: outlines of objects on the floor, seen from above.
    """

    painted: list[Painted] = field(default_factory=list)
    walls: list[Wall] = field(default_factory=list)
    obstacles: list[Rect] = field(default_factory=list)

    def flat(self, corner: Vector, edges: tuple[Vector, Vector], pattern: Texture | Pattern) -> None:
        """Add a flat surface."""
        self.painted.append((_bounded_quad(corner, *edges), pattern))

    def floor(self, rect: Rect, y: float, pattern: Texture | Pattern) -> None:
        """Add a level surface, a floor or a ceiling."""
        low_x, low_z, high_x, high_z = rect
        self.flat((low_x, y, low_z), ((high_x - low_x, 0.0, 0.0), (0.0, 0.0, high_z - low_z)), pattern)

    def wall(self, wall: Wall, pattern: Texture | Pattern, *, free: bool = True) -> None:
        """Add a wall; if it is free, it can have pictures."""
        edges = vector(wall.length * np.array(wall.along)), (0.0, -wall.height, 0.0)
        self.flat(wall.foot, edges, pattern)
        self.walls += [wall] * free

    def walls_around(self, rect: Rect, height: float, pattern: Pattern) -> None:
        """Add the four walls of a room."""
        low_x, low_z, high_x, high_z = rect
        wide, deep = high_x - low_x, high_z - low_z
        self.wall(Wall((low_x, 0.0, high_z), (1.0, 0.0, 0.0), wide, height), pattern)
        self.wall(Wall((high_x, 0.0, high_z), (0.0, 0.0, -1.0), deep, height), pattern)
        self.wall(Wall((high_x, 0.0, low_z), (-1.0, 0.0, 0.0), wide, height), pattern)
        self.wall(Wall((low_x, 0.0, low_z), (0.0, 0.0, 1.0), deep, height), pattern)

    def block(self, low: Vector, high: Vector, pattern: Texture | Pattern) -> None:
        """Add a box that is seen from outside."""
        middle, radius = _sphere(low, high)
        self.painted.append((Bounded(Cuboid(low, high, OAK), middle, radius), pattern))

    def rod(self, foot: Vector, head: Vector, radius: float, pattern: Texture | Pattern) -> None:
        """Add a rod."""
        middle, reach = _sphere(foot, head)
        rod = Rod(foot, head, radius, STEEL)
        self.painted.append((Bounded(rod, middle, float(np.hypot(reach, radius))), pattern))

    def stand(self, rect: Rect) -> None:
        """Add an obstacle for cameras."""
        self.obstacles.append(rect)

    def unique_things(self, unique: float, rng: np.random.Generator, *, furniture: bool = True) -> None:
        """Hang unique pictures on the walls and put unique furniture in front of them.

        Args:
            unique: share in [0, 1] of the available positions that are used.
            rng: source of randomness.
            furniture: whether to add furniture.
        """
        slots = [
            (wall, (number + 0.5) * wall.length / int(wall.length / _SLOT))
            for wall in self.walls
            for number in range(int(wall.length / _SLOT))
        ]
        order = rng.permutation(len(slots))
        for idx in order[: round(0.8 * unique * len(slots))]:
            self._picture(slots[idx][0], slots[idx][1], rng)
        for idx in order[len(slots) - round(0.4 * unique * len(slots)) :] if furniture else ():
            self._furniture(slots[idx][0], slots[idx][1], rng)

    def _picture(self, wall: Wall, along: float, rng: np.random.Generator) -> None:
        wide, high = (float(side) for side in rng.uniform(0.45, 1.1, 2))
        wide = min(wide, wall.length - 0.4)
        along, up = along + rng.uniform(-0.12, 0.12), min(rng.uniform(1.0, 1.5), wall.height - high - 0.1)
        corner = wall.at(along - wide / 2, up + high, 0.02)
        pattern = _own_print("poster", (wide, high), corner, rng)
        self.painted.append((_bounded_quad(corner, vector(wide * np.array(wall.along)), (0.0, high, 0.0)), pattern))

    def _furniture(self, wall: Wall, along: float, rng: np.random.Generator) -> None:
        """Put a cabinet, a bench with objects on it, or a plant in front of a wall."""
        half, deep, high = rng.uniform(0.3, 0.6), rng.uniform(0.25, 0.5), rng.uniform(0.35, 1.1)
        kind = rng.integers(3)
        near, far = wall.at(along - half, 0.0, 0.03), wall.at(along + half, high, 0.03 + deep)
        low, top = corners(near, far)
        if kind < 2:
            self.block(low, top, _own_print("cabinet", (2 * half, high), low, rng))
        if kind == 1:
            radius = rng.uniform(0.1, 0.2)
            center = wall.at(along, high + radius, 0.03 + deep / 2)
            self._ball(center, radius, rng)
        if kind == 2:
            foot, head = wall.at(along, 0.0, 0.35), wall.at(along, 0.4, 0.35)
            self.rod(foot, head, 0.16, _own_print("cabinet", (0.4, 0.4), foot, rng))
            for _ in range(3):
                center = wall.at(along + rng.uniform(-0.12, 0.12), rng.uniform(0.5, 1.1), rng.uniform(0.3, 0.4))
                self._ball(center, rng.uniform(0.15, 0.25), rng, LEAVES)
            low, top = corners(wall.at(along - 0.35, 0.0, 0.0), wall.at(along + 0.35, 0.0, 0.7))
        self.stand((low[0], low[2], top[0], top[2]))

    def _ball(self, center: Vector, radius: float, rng: np.random.Generator, colors: Colors | None = None) -> None:
        drawing = Drawing("gravel", colors or _paint(rng), int(rng.integers(1 << 30)))
        print_ = Print(drawing, (0.8, 0.8), center)
        self.painted.append((Bounded(Ball(center, float(radius), OAK), center, float(radius)), print_))


def vector(values: FloatArray) -> Vector:
    """Return an array (3,) as a tuple."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def _own_print(kind: Kind, size: tuple[float, float], origin: Vector, rng: np.random.Generator) -> Print:
    """Return one print of a unique drawing."""
    colors = _paint(rng)[0], _paint(rng)[1]
    return Print(Drawing(kind, colors, int(rng.integers(1 << 30))), size, origin)


def _paint(rng: np.random.Generator) -> Colors:
    return _PAINTS[rng.integers(len(_PAINTS))]


def _bounded_quad(corner: Vector, edge_u: Vector, edge_v: Vector) -> Surface:
    return Bounded(Quad(corner, edge_u, edge_v, WHITE), *_sphere(corner, vector(np.array(corner) + edge_u + edge_v)))


def corners(first: Vector, second: Vector) -> tuple[Vector, Vector]:
    """Return the low and the high corner of the box between two points."""
    return vector(np.minimum(first, second)), vector(np.maximum(first, second))


def _sphere(low: Vector, high: Vector) -> tuple[Vector, float]:
    """Return the sphere around a box."""
    return vector(0.5 * (np.array(low) + high)), 0.5 * float(np.linalg.norm(np.array(high) - low)) + 1e-6
