"""Places for single parts of the product: a yard, a room with windows, a plain table and a large plain room.

Settings are those of `tests.synthetic.scenes`.
"""

from __future__ import annotations

import numpy as np

from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Surface, Vector
from tests.synthetic.bounded import Bounded
from tests.synthetic.paints import BLUE, BRICK, LEAVES, OAK, RED, STEEL, STONE, WHITE
from tests.synthetic.rod import Rod
from tests.synthetic.scenes import Painted, Scene, painted, placed

_GROUND, _TOP, _FLOOR, _WALL = 1.6, -1.5, 1.3, 0.25


def yard(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0, sky: str = "blue") -> Scene:
    """Return a yard of 60 × 60 under an open sky that is seen behind branches, through windows and between slats.

    It is not one of `SCENES`, since the branches take long to render.
    """
    rng = np.random.default_rng([seed, 0x7A])
    surfaces: list[Painted] = [
        (surface, "outdoor")
        for surface in (*_ground_and_houses(), *_wall_with_windows(), *_pergola(), *_hedges(), *_trees(rng))
    ]
    room = painted("yard", surfaces, seed=seed, lamp=(-20.0, -60.0, -30.0), sky=sky)
    return placed("yard", room, views=views, turned=turned, spread=(0.8, 0.2, 0.8), exposure=exposure, outdoor=True)


def window_room(
    *, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0, sky: str = "overcast"
) -> Scene:
    """Return a room of 6 × 2.8 × 5 with white walls, a balcony door and two windows, through which the sky is seen.

    It is not one of `SCENES`, since its sky is for `filters.sky` alone.
    """
    room = painted(
        "windows", [*_walls(), *_frames(), *_furniture(), *_outside()], seed=seed, lamp=(0.4, -1.2, 0.3), sky=sky
    )
    return placed("window_room", room, views=views, turned=turned, spread=(0.7, 0.25, 0.7), exposure=exposure)


def plain_table(
    *, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0, height: float = 0.4
) -> Scene:
    """Return a room of 6 × 2.9 × 5 with cameras above a large table that has hardly any texture, and nothing on it.

    All other surfaces are farther away. It is not one of `SCENES`, since it is for near limits alone.
    """
    surfaces: list[Painted] = [
        (Cuboid((-3.0, -1.7, -2.5), (3.0, 1.2, 2.5), STONE), "strong"),
        (Cuboid((-1.6, height, -1.1), (1.6, height + 0.04, 1.1), OAK), "faint"),
        (Cuboid((2.0, 0.3, -2.4), (2.8, 1.2, -1.0), BLUE), "strong"),
        (Cuboid((-2.8, -0.3, 1.4), (-2.0, 1.2, 2.4), BRICK), "strong"),
    ]
    room = painted("table", surfaces, seed=seed, lamp=(0.4, -1.4, 0.3))
    return placed("plain_table", room, views=views, turned=turned, spread=(0.9, 0.06, 0.6), exposure=exposure)


def large_plain_room(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return a nearly empty room of 12 × 4 × 9: plain walls and ceiling, a faint floor, a few small objects.

    Most key points are coarse, faint and few, so that they determine poses poorly. It is not one of `SCENES`, since
    most of its surfaces have no texture at all and no reliable ranges.
    """
    frame = ((0.70, 0.72, 0.74), (0.70, 0.72, 0.74))
    surfaces: list[Painted] = [
        (Cuboid((-6.0, -2.4, -4.5), (6.0, 1.6, 4.5), WHITE), "none"),
        (Quad((-6.0, 1.599, -4.5), (12.0, 0.0, 0.0), (0.0, 0.0, 9.0), STONE), "weak"),
        (Cuboid((-0.6, -0.6, 4.46), (0.5, 1.6, 4.5), frame), "none"),
        (Cuboid((2.5, -0.9, -4.5), (4.5, 0.7, -4.46), frame), "none"),
        (Cuboid((-4.0, 1.0, -4.5), (-2.2, 1.5, -4.38), WHITE), "none"),
        (Quad((-5.99, -0.6, -1.0), (0.0, 0.0, 1.4), (0.0, 1.0, 0.0), BLUE), "weak"),
        (Quad((2.0, -0.7, 4.49), (1.6, 0.0, 0.0), (0.0, 1.1, 0.0), RED), "weak"),
        (Quad((5.99, -0.4, 1.5), (0.0, 0.0, 0.9), (0.0, 0.7, 0.0), LEAVES), "strong"),
        (Cuboid((-5.0, 0.85, 2.2), (-3.2, 0.9, 3.2), OAK), "strong"),
        (Rod((-4.9, 0.9, 2.3), (-4.9, 1.6, 2.3), 0.04, OAK), "strong"),
        (Rod((-3.3, 0.9, 3.1), (-3.3, 1.6, 3.1), 0.04, OAK), "strong"),
        (Cuboid((4.6, 0.0, -2.2), (5.6, 1.6, -1.2), WHITE), "none"),
        (Ball((-2.6, 1.3, -3.4), 0.3, LEAVES), "strong"),
        (Ball((0.0, -1.9, 0.0), 0.25, WHITE), "none"),
        (Rod((0.0, -2.4, 0.0), (0.0, -1.9, 0.0), 0.02, STEEL), "none"),
    ]
    room = painted("large plain room", surfaces, seed=seed, lamp=(1.0, -1.2, 0.8))
    return placed("large_plain_room", room, views=views, turned=turned, spread=(2.0, 0.4, 2.0), exposure=exposure)


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


def _ground_and_houses() -> list[Surface]:
    return [
        Quad((-30, _GROUND, -30), (60, 0, 0), (0, 0, 60), LEAVES),
        Cuboid((-22, -3.5, 8), (-14, _GROUND, 26), BRICK),
        Cuboid((12, -6, 14), (22, _GROUND, 28), STONE),
        Cuboid((10, -2.5, -26), (24, _GROUND, -16), BRICK),
        Cuboid((-30, -1.0, -30), (-26, _GROUND, -2), STONE),
    ]


def _wall_with_windows() -> list[Surface]:
    """Return a wall 3.5 in front of the first camera, 4.6 high, with two rows of windows that have a cross bar."""
    front, back, top = 3.5, 3.9, -3.0
    wall: list[Surface] = [
        Cuboid((-4.5, 0.4, front), (3.5, _GROUND, back), BRICK),
        Cuboid((-4.5, -1.05, front), (3.5, -0.75, back), BRICK),
        Cuboid((-4.5, top, front), (3.5, -2.4, back), BRICK),
    ]
    for x in (-4.5, -2.5, -0.5, 1.5, 3.0):
        wall.append(Cuboid((x, top, front), (x + 0.5, _GROUND, back), BRICK))
    for x in (-3.25, -1.25, 0.75):
        wall.append(Rod((x, -2.4, 3.7), (x, 0.4, 3.7), 0.025, OAK))
    for y in (-0.2, -1.7):
        wall.append(Rod((-4.5, y, 3.7), (3.5, y, 3.7), 0.025, OAK))
    return wall


def _pergola() -> list[Surface]:
    posts = [Rod((x, _GROUND, z), (x, -1.2, z), 0.06, OAK) for x in (-3.4, -1.4) for z in (-4.5, -2.2)]
    beams = [Rod((x, -1.2, -4.9), (x, -1.2, -1.8), 0.06, OAK) for x in (-3.4, -1.4)]
    slats = [Rod((-3.8, -1.3, z), (-1.0, -1.3, z), 0.04, OAK) for z in np.arange(-4.7, -1.8, 0.4).tolist()]
    return [*posts, *beams, *slats]


def _hedges() -> list[Surface]:
    hedges: list[Surface] = [Ball((x, 1.1, -11.0 + 0.4 * (x % 3)), 1.1, LEAVES) for x in range(-12, 10, 2)]
    return [*hedges, Rod((5.0, _GROUND, 1.0), (5.0, -3.2, 1.0), 0.05, STEEL)]


def _trees(rng: np.random.Generator) -> list[Surface]:
    """Return four trees; each branch bears three thinner ones, the last of which are a pixel or two thick."""
    surfaces: list[Surface] = []
    for x, z, height in ((3.2, -2.6, 2.6), (-5.2, 1.5, 3.2), (7.5, 5.0, 4.5), (1.0, -7.5, 4.0)):
        foot, head = np.array([x, _GROUND, z]), np.array([x + 0.1, _GROUND - 0.55 * height, z])
        surfaces.append(Rod(_vector(foot), _vector(head), 0.035 * height, OAK))
        _grow(
            surfaces,
            rng,
            head,
            along=np.array([0.0, -1.0, 0.0]),
            length=0.55 * height,
            radius=0.02 * height,
            generations=3,
        )
    return surfaces


def _grow(
    surfaces: list[Surface],
    rng: np.random.Generator,
    start: np.ndarray,
    *,
    along: np.ndarray,
    length: float,
    radius: float,
    generations: int,
) -> None:
    for _ in range(3 if generations else 0):
        direction = along + rng.normal(0, 0.6, 3)
        direction /= np.linalg.norm(direction)
        direction[1] = min(direction[1], 0.3)
        end = start + direction * length * rng.uniform(0.5, 0.75)
        branch = Rod(_vector(start), _vector(end), radius, OAK)
        reach = float(np.linalg.norm(end - start)) / 2 + radius
        surfaces.append(Bounded(branch, _vector((start + end) / 2), reach))
        _grow(
            surfaces, rng, end, along=direction, length=0.7 * length, radius=0.55 * radius, generations=generations - 1
        )


def _vector(point: np.ndarray) -> Vector:
    return float(point[0]), float(point[1]), float(point[2])
