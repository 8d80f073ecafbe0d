"""Furniture of rendered houses: each piece is a few boxes, with its back against a wall."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from tools.benchmarks.poses.tours.materials import (
    BOOKS,
    CARPET,
    FABRIC,
    LEAVES,
    MIRROR,
    PANELS,
    PLAIN,
    POSTER,
    SCREEN,
    STONE,
    WOOD,
)

Color = tuple[float, float, float]
WHITE: Color = (0.86, 0.86, 0.84)
GREY: Color = (0.45, 0.46, 0.48)
DARK: Color = (0.12, 0.12, 0.13)
GREEN: Color = (0.2, 0.34, 0.12)
WOODS: tuple[Color, ...] = ((0.62, 0.43, 0.26), (0.45, 0.29, 0.17), (0.75, 0.62, 0.45), (0.3, 0.2, 0.14))
CLOTHS: tuple[Color, ...] = (
    (0.35, 0.4, 0.5), (0.55, 0.5, 0.44), (0.28, 0.3, 0.3), (0.6, 0.35, 0.28), (0.3, 0.42, 0.36),
)  # fmt: skip


@dataclass(frozen=True)
class Part:
    """A box of a piece of furniture.

    Attributes:
        low: (3,) corner: x along the wall from the middle of the piece, y away from the wall, z above the floor.
        high: (3,) opposite corner.
        material: of `tools.benchmarks.poses.tours.materials`.
        color: of the material.
        turn_deg: turn about the vertical through the middle of the box.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    material: int
    color: Color
    turn_deg: float = 0.0


Piece = Callable[[np.random.Generator], Iterator[Part]]


def _pick(rng: np.random.Generator, colors: tuple[Color, ...]) -> Color:
    return colors[int(rng.integers(len(colors)))]


def _legs(wide: float, deep: float, high: float, color: Color) -> Iterator[Part]:
    for x in (-0.5 * wide, 0.5 * wide - 0.05):
        for y in (0.02, deep - 0.07):
            yield Part((x, y, 0.0), (x + 0.05, y + 0.05, high), WOOD, color)


def _chair(x: float, y: float, turn_deg: float, color: Color) -> Iterator[Part]:
    """Yield a chair; its back is on the side of +y before it is turned by a multiple of 90°."""
    sign = {0: (0, 1), 90: (-1, 0), 180: (0, -1), 270: (1, 0)}[int(turn_deg)]
    yield Part((x - 0.21, y - 0.21, 0.43), (x + 0.21, y + 0.21, 0.47), WOOD, color)
    for dx in (-0.2, 0.16):
        for dy in (-0.2, 0.16):
            yield Part((x + dx, y + dy, 0.0), (x + dx + 0.04, y + dy + 0.04, 0.43), WOOD, color)
    bx, by = x + 0.19 * sign[0], y + 0.19 * sign[1]
    half = (0.02, 0.21) if sign[0] else (0.21, 0.02)
    yield Part((bx - half[0], by - half[1], 0.55), (bx + half[0], by + half[1], 0.92), WOOD, color)


def bed(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a bed with pillows, a blanket and two tables beside it."""
    wood, cloth, wide = _pick(rng, WOODS), _pick(rng, CLOTHS), float(rng.uniform(1.2, 1.7))
    yield Part((-wide / 2, 0.0, 0.0), (wide / 2, 0.05, 1.0), WOOD, wood)
    yield Part((-wide / 2, 0.05, 0.1), (wide / 2, 2.05, 0.5), FABRIC, WHITE)
    yield Part((-wide / 2 - 0.02, 0.6, 0.2), (wide / 2 + 0.02, 2.08, 0.55), FABRIC, cloth)
    for x in (-wide / 4, wide / 4):
        turn = float(rng.uniform(-15, 15))
        yield Part((x - 0.28, 0.12, 0.5), (x + 0.28, 0.48, 0.62), FABRIC, _pick(rng, CLOTHS), turn)
    for side in (-1, 1):
        x = side * (wide / 2 + 0.28)
        yield Part((x - 0.2, 0.02, 0.0), (x + 0.2, 0.4, 0.5), PANELS, wood)
        yield Part((x - 0.09, 0.12, 0.5), (x + 0.09, 0.3, 0.85), FABRIC, (0.9, 0.8, 0.6), 30.0)


def sofa(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a sofa with cushions, a rug and a low table."""
    cloth, wide = _pick(rng, CLOTHS), float(rng.uniform(1.7, 2.3))
    yield Part((-wide / 2, 0.05, 0.05), (wide / 2, 0.9, 0.42), FABRIC, cloth)
    yield Part((-wide / 2, 0.05, 0.42), (wide / 2, 0.3, 0.82), FABRIC, cloth)
    for side in (-1, 1):
        low, high = sorted((side * wide / 2, side * (wide / 2 - 0.2)))
        yield Part((low, 0.05, 0.05), (high, 0.9, 0.62), FABRIC, cloth)
    for x in rng.uniform(-0.4 * wide, 0.4 * wide, 3):
        turn = float(rng.uniform(-40, 40))
        yield Part((x - 0.2, 0.3, 0.42), (x + 0.2, 0.45, 0.78), FABRIC, _pick(rng, CLOTHS), turn)
    yield Part((-wide / 2, 0.7, 0.0), (wide / 2, 2.4, 0.012), CARPET, _pick(rng, CLOTHS))
    wood = _pick(rng, WOODS)
    yield Part((-0.5, 1.3, 0.36), (0.5, 1.85, 0.41), WOOD, wood)
    yield Part((-0.42, 1.36, 0.0), (0.42, 1.8, 0.05), WOOD, wood)
    yield Part((-0.06, 1.5, 0.0), (0.06, 1.62, 0.36), WOOD, wood)
    yield Part((0.1, 1.45, 0.41), (0.35, 1.65, 0.43), POSTER, _pick(rng, CLOTHS), float(rng.uniform(0, 90)))


def table(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a table with four chairs, a bowl and a lamp."""
    wood = _pick(rng, WOODS)
    yield Part((-0.8, 0.9, 0.71), (0.8, 1.75, 0.75), WOOD, wood)
    for part in _legs(1.5, 0.75, 0.71, wood):
        (x0, y0, z0), (x1, y1, z1) = part.low, part.high
        yield Part((x0, y0 + 0.95, z0), (x1, y1 + 0.95, z1), WOOD, wood)
    seat = _pick(rng, WOODS)
    for x in (-0.4, 0.4):
        yield from _chair(x, 0.72 + float(rng.uniform(-0.08, 0.05)), 180, seat)
        yield from _chair(x, 1.95 + float(rng.uniform(-0.05, 0.1)), 0, seat)
    yield Part((-0.12, 1.2, 0.75), (0.12, 1.44, 0.9), LEAVES, GREEN, 45.0)
    yield Part((-0.25, 1.1, 1.75), (0.25, 1.5, 1.95), PLAIN, _pick(rng, CLOTHS))


def desk(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a desk with a screen, papers and a chair."""
    wood, wide = _pick(rng, WOODS), 1.5
    yield Part((-wide / 2, 0.02, 0.7), (wide / 2, 0.75, 0.74), WOOD, wood)
    yield from _legs(wide, 0.72, 0.7, GREY)
    yield Part((-0.3, 0.15, 0.85), (0.3, 0.18, 1.2), SCREEN, DARK, float(rng.uniform(-8, 8)))
    yield Part((-0.04, 0.14, 0.74), (0.04, 0.2, 0.86), PLAIN, DARK)
    yield Part((-0.22, 0.35, 0.74), (0.22, 0.5, 0.76), PLAIN, GREY)
    for x in rng.uniform(-0.6, 0.5, 3):
        turn = float(rng.uniform(0, 90))
        yield Part((x, 0.3, 0.74), (x + 0.15, 0.5, 0.75 + 0.05 * float(rng.random())), POSTER, WHITE, turn)
    yield from _chair(float(rng.uniform(-0.1, 0.1)), 0.85, 0, _pick(rng, CLOTHS))


def shelf(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a shelf of books with a plant on it."""
    wide, high = float(rng.uniform(0.7, 1.6)), float(rng.choice([1.05, 1.4, 1.75]))
    yield Part((-wide / 2, 0.01, 0.05), (wide / 2, 0.32, high), BOOKS, _pick(rng, WOODS))
    yield Part((-wide / 2 - 0.02, 0.0, high), (wide / 2 + 0.02, 0.34, high + 0.03), WOOD, _pick(rng, WOODS))
    x = float(rng.uniform(-0.3, 0.3)) * wide
    yield Part((x - 0.07, 0.1, high + 0.03), (x + 0.07, 0.24, high + 0.15), PLAIN, _pick(rng, CLOTHS))
    yield Part((x - 0.12, 0.05, high + 0.15), (x + 0.12, 0.29, high + 0.38), LEAVES, GREEN, 30.0)


def wardrobe(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a wardrobe with doors, one of them sometimes a mirror."""
    doors, color = int(rng.integers(2, 5)), WHITE if rng.random() < 0.5 else _pick(rng, WOODS)
    mirrored = int(rng.integers(doors)) if rng.random() < 0.4 else -1
    for door in range(doors):
        x = 0.5 * (door - doors / 2)
        yield Part((x, 0.01, 0.03), (x + 0.495, 0.6, 2.05), PANELS, color)
        if door == mirrored:
            yield Part((x + 0.06, 0.6, 0.2), (x + 0.44, 0.61, 1.95), MIRROR, WHITE)


def kitchen(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a kitchen: cupboards, a worktop, a hob, an oven, a sink, a refrigerator."""
    front = WHITE if rng.random() < 0.6 else _pick(rng, WOODS)
    count = int(rng.integers(3, 6))
    for unit in range(count):
        x = 0.6 * (unit - count / 2)
        oven = unit == 1
        yield Part((x, 0.02, 0.1), (x + 0.595, 0.6, 0.86), SCREEN if oven else PANELS, DARK if oven else front)
        if unit != count - 1:
            yield Part((x, 0.02, 1.45), (x + 0.595, 0.36, 2.1), PANELS, front)
    left, right = -0.3 * count, 0.3 * count
    yield Part((left, 0.0, 0.86), (right, 0.63, 0.9), STONE, GREY)
    yield Part((left + 0.65, 0.08, 0.9), (left + 1.15, 0.55, 0.905), PLAIN, DARK)
    yield Part((right - 0.9, 0.12, 0.9), (right - 0.4, 0.5, 0.903), MIRROR, GREY)
    yield Part((right, 0.02, 0.0), (right + 0.6, 0.65, 1.85), PANELS, (0.7, 0.71, 0.73))
    for x in rng.uniform(left + 0.1, right - 0.2, 4):
        high, turn = 0.92 + float(rng.uniform(0.08, 0.3)), float(rng.uniform(0, 90))
        yield Part((x, 0.1, 0.9), (x + 0.12, 0.24, high), STONE, _pick(rng, CLOTHS), turn)


def bath(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a bath tub, a sink with a mirror, and a toilet."""
    yield Part((-1.3, 0.0, 0.0), (-0.55, 1.65, 0.55), PLAIN, WHITE)
    yield Part((-1.22, 0.08, 0.54), (-0.63, 1.57, 0.555), PLAIN, (0.6, 0.62, 0.63))
    yield Part((-0.3, 0.02, 0.1), (0.4, 0.48, 0.82), PANELS, _pick(rng, WOODS))
    yield Part((-0.32, 0.0, 0.82), (0.42, 0.5, 0.87), PLAIN, WHITE)
    yield Part((-0.3, 0.005, 1.15), (0.4, 0.02, 1.9), MIRROR, WHITE)
    yield Part((0.75, 0.0, 0.0), (1.1, 0.2, 0.85), PLAIN, WHITE)
    yield Part((0.74, 0.2, 0.0), (1.11, 0.68, 0.42), PLAIN, WHITE)
    yield Part((-0.5, 0.6, 0.0), (0.4, 1.2, 0.012), CARPET, _pick(rng, CLOTHS))


def television(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a screen on a low cupboard."""
    yield Part((-0.9, 0.02, 0.05), (0.9, 0.45, 0.48), PANELS, _pick(rng, (*WOODS, WHITE)))
    yield Part((-0.6, 0.12, 0.55), (0.6, 0.16, 1.25), SCREEN, DARK)
    yield Part((0.65, 0.1, 0.48), (0.85, 0.3, 0.7), LEAVES, GREEN, 20.0)


def plant(rng: np.random.Generator) -> Iterator[Part]:
    """Yield a large plant in a pot."""
    yield Part((-0.17, 0.1, 0.0), (0.17, 0.44, 0.35), STONE, _pick(rng, CLOTHS), 45.0)
    for _ in range(14):
        x, y, z = rng.uniform((-0.3, 0.0, 0.45), (0.3, 0.55, 1.35))
        size = float(rng.uniform(0.04, 0.13))
        turn = float(rng.uniform(0, 90))
        yield Part((x - size, y, z), (x + size, y + 0.03, z + 1.5 * size), LEAVES, GREEN, turn)


def boxes(rng: np.random.Generator) -> Iterator[Part]:
    """Yield moving boxes."""
    high = 0.0
    for _ in range(int(rng.integers(1, 4))):
        wide, deep, tall = rng.uniform((0.35, 0.3, 0.25), (0.6, 0.45, 0.45))
        turn = float(rng.uniform(-12, 12))
        yield Part((-wide / 2, 0.08, high), (wide / 2, 0.08 + deep, high + tall), WOOD, (0.6, 0.46, 0.3), turn)
        high += float(tall)


BY_ROOM: dict[str, tuple[Piece, ...]] = {
    "living": (sofa, television, shelf, plant, table),
    "bedroom": (bed, wardrobe, desk, plant),
    "study": (desk, shelf, shelf, sofa),
    "kitchen": (kitchen, table, plant),
    "bath": (bath,),
    "office": (desk, desk, desk, shelf),
    "store": (boxes, boxes, shelf),
    "corridor": (plant,),
    "hall": (plant, shelf),
}
