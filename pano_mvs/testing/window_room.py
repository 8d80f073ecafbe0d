"""Surfaces of a plain room with windows to the sky, on the first floor; y is down, the floor is at 1.3."""

from __future__ import annotations

from pano_mvs.testing.paint import BLUE, BRICK, LEAVES, OAK, RED, STONE, WHITE, Texture
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Rod, Surface

Painted = tuple[Surface, Texture]

_TOP, _FLOOR = -1.5, 1.3
_WALL = 0.25


def window_room_surfaces() -> tuple[Painted, ...]:
    """Return the walls with a balcony door and two windows, furniture, and what is outside."""
    return *_walls(), *_frames(), *_furniture(), *_outside()


def _walls() -> list[Painted]:
    """Return white walls and a white ceiling; two windows in the wall ahead, a balcony door in the right one."""
    ahead, right = 2.5, 3.0
    parts = [
        Cuboid((-3.3, _TOP - _WALL, -2.75), (3.3, _TOP, 2.75), WHITE),
        Cuboid((-3.3, _TOP, -2.75), (3.3, _FLOOR, -2.5), WHITE),
        Cuboid((-3.25, _TOP, -2.75), (-3.0, _FLOOR, 2.75), WHITE),
        # Ahead: below, above and beside two windows of 1.4 × 1.4 and 1.6 × 1.4.
        Cuboid((-3.0, 0.4, ahead), (3.25, _FLOOR, ahead + _WALL), WHITE),
        Cuboid((-3.0, _TOP, ahead), (3.25, -1.0, ahead + _WALL), WHITE),
        *(
            Cuboid((a, -1.0, ahead), (b, 0.4, ahead + _WALL), WHITE)
            for a, b in ((-3.0, -2.2), (-0.8, 0.6), (2.2, 3.25))
        ),
        # Right: beside and above a door of 2 × 2.3.
        Cuboid((right, _TOP, -2.75), (right + _WALL, _FLOOR, -1.0), WHITE),
        Cuboid((right, _TOP, 1.0), (right + _WALL, _FLOOR, 2.75), WHITE),
        Cuboid((right, _TOP, -1.0), (right + _WALL, -1.2, 1.0), WHITE),
    ]
    floor = Quad((-3.3, _FLOOR, -2.75), (6.6, 0.0, 0.0), (0.0, 0.0, 5.5), OAK)
    return [*((part, "none") for part in parts), (floor, "strong")]


def _frames() -> list[Painted]:
    """Return a bar in each window and two in the door."""
    upright = [Rod((x, -1.0, 2.6), (x, 0.4, 2.6), 0.03, OAK) for x in (-1.5, 1.4)]
    level = [Rod((a, -0.5, 2.6), (b, -0.5, 2.6), 0.025, OAK) for a, b in ((-2.2, -0.8), (0.6, 2.2))]
    door = [Rod((3.1, _TOP, z), (3.1, _FLOOR, z), 0.04, OAK) for z in (-0.3, 0.4)]
    return [(bar, "strong") for bar in (*upright, *level, *door)]


def _furniture() -> list[Painted]:
    return [
        (Cuboid((-2.9, 0.5, -1.0), (-1.9, _FLOOR, 1.0), BLUE), "strong"),
        (Cuboid((0.6, 0.45, -2.2), (2.2, 0.52, -1.3), OAK), "strong"),
        (Rod((0.7, 0.52, -2.1), (0.7, _FLOOR, -2.1), 0.04, OAK), "strong"),
        (Rod((2.1, 0.52, -1.4), (2.1, _FLOOR, -1.4), 0.04, OAK), "strong"),
        (Quad((-2.99, -0.9, -0.6), (0.0, 0.0, 1.2), (0.0, 0.8, 0.0), RED), "strong"),
        (Quad((-1.2, -1.0, -2.49), (1.4, 0.0, 0.0), (0.0, 0.9, 0.0), LEAVES), "strong"),
        (Ball((-0.6, 1.05, 1.7), 0.25, LEAVES), "strong"),
        (Rod((0.0, _TOP, 0.4), (0.0, -1.1, 0.4), 0.02, OAK), "strong"),
        (Ball((0.0, -1.0, 0.4), 0.12, WHITE), "none"),
    ]


def _outside() -> list[Painted]:
    """Return the ground 3.2 below the floor, houses across the street, and trees."""
    surfaces: list[Surface] = [
        Quad((-40, 4.5, -40), (80, 0, 0), (0, 0, 80), STONE),
        Cuboid((-12, -1.5, 16), (-2, 4.5, 24), BRICK),
        Cuboid((3, 0.5, 18), (14, 4.5, 26), STONE),
        Cuboid((14, -3.0, -8), (22, 4.5, 2), BRICK),
        Rod((8.0, 4.5, 3.0), (8.0, 0.5, 3.0), 0.15, OAK),
        Ball((8.0, 0.0, 3.0), 1.4, LEAVES),
        Ball((7.6, -0.8, 3.5), 0.8, LEAVES),
    ]
    return [(surface, "outdoor") for surface in surfaces]
