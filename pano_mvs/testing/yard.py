"""Surfaces of a yard under an open sky: bare trees, a wall with windows, a pergola; y is down, the ground at 1.6."""

from __future__ import annotations

import numpy as np

from pano_mvs.testing.paint import BRICK, LEAVES, OAK, STEEL, STONE
from pano_mvs.testing.surfaces import Ball, Bounded, Cuboid, Quad, Rod, Surface, Vector

_GROUND = 1.6


def yard_surfaces(seed: int = 0) -> tuple[Surface, ...]:
    """Return the ground, houses, a ruined wall with windows, a pergola, hedges and trees without leaves."""
    rng = np.random.default_rng([seed, 0x7A])
    return *_ground_and_houses(), *_wall_with_windows(), *_pergola(), *_hedges(), *_trees(rng)


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
