"""Halls with repeated structure: a tiled floor, rows of columns."""

from __future__ import annotations

from typing import Literal, Unpack

import numpy as np

from tests.synthetic.paints import OAK, WHITE
from tests.synthetic.scenes import Scene
from tools.benchmarks.repeating.drawings import Drawing
from tools.benchmarks.repeating.fittings import Site, Wall
from tools.benchmarks.repeating.prints import Print
from tools.benchmarks.repeating.visits import (
    SAND,
    STONES,
    Tiles,
    Visit,
    captured,
    floor_print,
    printed,
    shrunk,
    unique_rng,
    wall_print,
)
from tools.benchmarks.repeating.walks import Ground, Rect


def tiled_hall(
    *,
    size: tuple[float, float] = (9.0, 7.0),
    tile: float = 0.6,
    tiles: Tiles = "marble",
    wear: float = 0.0,
    walls: Literal["plain", "weak"] = "plain",
    **visit: Unpack[Visit],
) -> Scene:
    """Return a hall with a tiled floor, a hung ceiling and a door at one end.

    Args:
        size: extent along x and z.
        tile: side of a tile; the floor repeats after one tile, "checker" after two.
        tiles: pattern of the tiles.
        wear: share in [0, 1] of non-repeating texture on the floor.
        walls: "plain" panels that repeat after 1.2, or "weak": with a faint, non-repeating texture.
        visit: see `Visit`.
    """
    site, (wide, deep), height = Site(), size, 3.4
    rng = np.random.default_rng([visit.get("seed", 0), 0x4A])
    rect = (-wide / 2, -deep / 2, wide / 2, deep / 2)
    site.floor(rect, 0.0, floor_print(tile, tiles, rng, wear=wear))
    site.floor(rect, -height, printed("ceiling", WHITE, (1.2, 1.2)))
    site.walls_around(rect, height, wall_print(height, rng, wear=0.12 * (walls == "weak")))
    door = Wall((wide / 2 - 0.01, 0.0, 0.9), (0.0, 0.0, -1.0), 1.8, 2.4)
    site.wall(door, printed("door", OAK, (1.8, 2.4), (0.0, 0.0, -0.9)), free=False)
    site.unique_things(visit.get("unique", 0.5), unique_rng(visit))
    return captured("tiled_hall", site, Ground((shrunk(rect),), tuple(site.obstacles)), visit)


def colonnade(
    *,
    rows: int = 2,
    columns: int = 6,
    spacing: float = 2.8,
    tile: float = 0.6,
    tiles: Tiles = "marble",
    walled: bool = True,
    wear: float = 0.0,
    **visit: Unpack[Visit],
) -> Scene:
    """Return rows of equal columns on a tiled floor, in a hall or in the open.

    Args:
        rows: number of rows.
        columns: number of columns in each row, along z.
        spacing: distance between columns and between rows.
        tile: side of a tile.
        tiles: pattern of the tiles.
        walled: whether there are walls and a ceiling; otherwise there are beams on the columns and gravel around the
            floor.
        wear: share in [0, 1] of non-repeating texture on the floor.
        visit: see `Visit`; without walls, pictures hang on the columns.
    """
    site, height = Site(), 4.2
    rng = np.random.default_rng([visit.get("seed", 0), 0xC1])
    half_x, half_z = spacing * (rows + 1) / 2, spacing * (columns + 1) / 2
    rect: Rect = (-half_x, -half_z, half_x, half_z)
    site.floor(rect, 0.0, floor_print(tile, tiles, rng, wear=wear))
    middles = [
        ((row - (rows - 1) / 2) * spacing, (idx - (columns - 1) / 2) * spacing)
        for row in range(rows)
        for idx in range(columns)
    ]
    _columns(site, middles, height, rng)
    if walled:
        site.floor(rect, -height, printed("ceiling", WHITE, (spacing / 2, spacing / 2)))
        site.walls_around(rect, height, wall_print(height, rng))
    else:
        site.floor((-60.0, -60.0, 60.0, 60.0), 0.05, printed("gravel", SAND, (1.7, 1.7)))
        _beams(site, sorted({x for x, _ in middles}), height, half_z - 0.6, spacing, rng)
        site.walls += [Wall((x - 0.68, 0.0, z - 0.3), (1.0, 0.0, 0.0), 1.36, 3.0) for x, z in middles]
        site.obstacles = [(x - 0.5, z - 0.35, x + 0.5, z + 0.35) for x, z in middles]  # the signs are wider
    site.unique_things(visit.get("unique", 0.5), unique_rng(visit), furniture=walled)
    return captured("colonnade", site, Ground((shrunk(rect),), tuple(site.obstacles)), visit, sky=not walled)


def _columns(site: Site, middles: list[tuple[float, float]], height: float, rng: np.random.Generator) -> None:
    """Add equal columns with a plinth and a capital."""
    stone, seed = STONES[rng.integers(3)], int(rng.integers(1 << 30))
    radius, half = float(rng.uniform(0.16, 0.26)), 0.32
    mantle, block = Drawing("column", stone, seed), Drawing("marble", stone, seed)
    for x, z in middles:
        site.rod(
            (x, -0.18, z), (x, 0.25 - height, z), radius, Print(mantle, (1.0, height - 0.43), (x, -0.18, z), wound=True)
        )
        for low, high in ((-0.18, 0.0), (-height, 0.25 - height)):
            site.block(
                (x - half, low, z - half),
                (x + half, high, z + half),
                Print(block, (2 * half, 2 * half), (x - half, low, z - half)),
            )
        site.stand((x - half, z - half, x + half, z + half))


def _beams(
    site: Site, at_x: list[float], height: float, half_length: float, spacing: float, rng: np.random.Generator
) -> None:
    """Add a beam along each row of columns."""
    stone = printed("gravel", STONES[rng.integers(3)], (spacing, 0.6), (0.0, 0.0, spacing / 2))
    for x in at_x:
        site.block((x - 0.3, -height - 0.6, -half_length), (x + 0.3, -height, half_length), stone)
