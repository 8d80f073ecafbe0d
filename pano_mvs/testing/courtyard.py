"""Surfaces of the synthetic courtyard; y is down, the pavement is 1.6 below the first camera."""

from __future__ import annotations

from pano_mvs.testing.paint import BLUE, BRICK, LEAVES, OAK, STEEL, STONE
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Rod, Surface


def courtyard_surfaces() -> tuple[Surface, ...]:
    """Return the pavement, buildings, an arcade, trees, a van, a bench and two lamp posts."""
    return *_buildings(), *_arcade(), *_trees(), *_street_furniture()


def _buildings() -> list[Surface]:
    """Return the pavement, and buildings with bays and with gaps through which the sky is seen."""
    bays = [Cuboid((-12, -5, z), (-11.2, -2, z + 2.5), STONE) for z in range(-12, 20, 6)]
    oriels = [Cuboid((11.3, -7, z), (12, -3, z + 2.5), BRICK) for z in range(-9, 23, 6)]
    return [
        Quad((-20, 1.6, -24), (40, 0, 0), (0, 0, 84), STONE),
        Cuboid((-16, -9, -16), (-12, 1.6, 22), BRICK),
        Cuboid((-16, -6, 26), (-12, 1.6, 58), STONE),
        Cuboid((12, -11, -16), (16, 1.6, 30), STONE),
        Cuboid((12, -7, 33), (16, 1.6, 58), BRICK),
        Cuboid((-10, -13, 56), (9, 1.6, 60), BRICK),
        Cuboid((-14, -7, -20), (14, 1.6, -17), STONE),
        *bays,
        *oriels,
    ]


def _arcade() -> list[Surface]:
    """Return columns 0.5 thick with a beam on top, 5 away from the first camera."""
    columns = [Rod((-5, 1.6, z), (-5, -2.2, z), 0.25, STONE) for z in range(-8, 17, 3)]
    return [*columns, Cuboid((-5.4, -2.9, -8.5), (-4.6, -2.2, 16.5), STONE)]


def _trees() -> list[Surface]:
    surfaces: list[Surface] = []
    for x, z, height in ((4.0, 5.0, 3.2), (5.5, -6.0, 4.0), (-1.5, 16.0, 5.0), (3.0, 30.0, 6.0), (7.0, 16.0, 4.5)):
        crown = 0.38 * height
        surfaces.append(Rod((x, 1.6, z), (x + 0.15, 1.6 - height, z), 0.05 * height, OAK))
        for dx, dy, dz in ((0.0, 0.0, 0.0), (0.5, 0.45, 0.35), (-0.55, 0.3, -0.3)):
            center = (x + dx * crown, 1.6 - height + dy * crown, z + dz * crown)
            surfaces.append(Ball(center, 0.75 * crown, LEAVES))
    return surfaces


def _street_furniture() -> list[Surface]:
    return [
        Cuboid((1.8, 0.1, -5.5), (3.6, 1.6, -3.0), BLUE),
        Cuboid((-2.6, 1.1, 2.6), (-0.8, 1.2, 3.1), OAK),
        Cuboid((-2.5, 1.2, 2.7), (-2.3, 1.6, 3.0), STEEL),
        Cuboid((-1.1, 1.2, 2.7), (-0.9, 1.6, 3.0), STEEL),
        Rod((2.2, 1.6, 2.4), (2.2, -3.4, 2.4), 0.05, STEEL),
        Rod((-3.2, 1.6, 8.0), (-3.2, -3.4, 8.0), 0.06, STEEL),
    ]
