"""Long places with repeated structure: house fronts along a lane, doors along a corridor, stairs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Unpack

import numpy as np

from pano_mvs.core.arrays import FloatArray
from tests.synthetic.paints import BLUE, BRICK, OAK, RED, STEEL, STONE, WHITE
from tests.synthetic.scenes import Scene
from tools.benchmarks.repeating.fittings import Site, Wall
from tools.benchmarks.repeating.visits import (
    PLASTER,
    SAND,
    STONES,
    TILES,
    Visit,
    captured,
    floor_print,
    printed,
    shrunk,
    unique_rng,
    wall_print,
)
from tools.benchmarks.repeating.walks import Ground, Rect


def facade_row(
    *, bays: int = 8, bay: float = 3.0, width: float = 6.0, tile: float = 0.5, **visit: Unpack[Visit]
) -> Scene:
    """Return a paved lane under the sky between two rows of equal houses, with plain houses at its ends.

    Args:
        bays: number of windows in a row.
        bay: distance between windows.
        width: width of the lane.
        tile: side of a paving stone.
        visit: see `Visit`; signs hang beside the windows.
    """
    site, length, storey = Site(), bays * bay, 3.2
    rng = np.random.default_rng([visit.get("seed", 0), 0xFA])
    rect = (-width / 2, -length / 2, width / 2, length / 2)
    site.floor(rect, 0.0, floor_print(tile, "marble", rng))
    paints = (BRICK, PLASTER, STONE, SAND)
    for side, wall in zip((-1, 1), _sides(rect, 2 * storey), strict=True):
        seed = int(rng.integers(1 << 30))
        front = printed("bay", paints[rng.integers(4)], (bay, storey), (0.0, 0.0, -length / 2), seed=seed)
        site.wall(wall, front, free=False)
        for z in np.arange(bays + 1) * bay - length / 2:  # between the bays, where the signs hang too
            low, high = sorted((side * width / 2, side * (width / 2 - 0.18)))
            stone = printed("gravel", STONE, (0.9, 0.8), (low, 0.0, float(z)), seed=seed)
            site.block((low, -2 * storey, float(z) - 0.2), (high, 0.0, float(z) + 0.2), stone)
        site.walls += _slots(wall, bays - 1, bay, 0.18)
    for wall in _ends(rect, 1.5 * storey):
        site.wall(wall, printed("gravel", paints[rng.integers(4)], (1.3, 1.3)))
    site.unique_things(visit.get("unique", 0.5), unique_rng(visit), furniture=False)
    ground = Ground((shrunk(rect, 0.8),), (), (0.0, 0.0), 0.0)
    return captured("facade_row", site, ground, visit, sky=True)


def doors(*, bays: int = 8, bay: float = 2.6, width: float = 2.2, tile: float = 0.5, **visit: Unpack[Visit]) -> Scene:
    """Return a corridor with equal doors on both sides, lamps in the ceiling, and plain ends.

    Args:
        bays: number of doors on a side.
        bay: distance between doors.
        width: width of the corridor.
        tile: side of a tile.
        visit: see `Visit`; pictures hang between the doors.
    """
    site, length, height = Site(), bays * bay, 2.6
    rng = np.random.default_rng([visit.get("seed", 0), 0xD0])
    rect = (-width / 2, -length / 2, width / 2, length / 2)
    site.floor(rect, 0.0, floor_print(tile, TILES[rng.integers(3)], rng))
    site.floor(rect, -height, printed("ceiling", WHITE, (width, bay), (-width / 2, 0.0, 0.0)))
    front = printed(
        "door",
        (OAK, BLUE, RED)[rng.integers(3)],
        (bay, height),
        (0.0, 0.0, -length / 2),
        seed=int(rng.integers(1 << 30)),
    )
    for wall in _sides(rect, height):
        site.wall(wall, front, free=False)
        site.walls += _slots(wall, bays - 1, bay, 0.0)
    for wall in _ends(rect, height):
        site.wall(wall, wall_print(height, rng))
    site.unique_things(visit.get("unique", 0.5), unique_rng(visit), furniture=False)
    return captured("doors", site, Ground((shrunk(rect, 0.5),), (), (0.0, 0.0), 0.0), visit)


def stairs(
    *, flights: int = 3, treads: int = 9, width: float = 2.4, landing: float = 1.5, **visit: Unpack[Visit]
) -> Scene:
    """Return a straight staircase of equal flights between two walls, with a landing at either end of each.

    Args:
        flights: number of flights.
        treads: number of treads of each flight; the last one is the landing.
        width: width of the stairs.
        landing: length of a landing.
        visit: see `Visit`; pictures hang along the walls.
    """
    site, rise, run = Site(), 0.165, 0.29
    rng = np.random.default_rng([visit.get("seed", 0), 0x57])
    flight = (treads - 1) * run + landing
    start, end, top = -(flights * flight + landing) / 2, (flights * flight + landing) / 2, flights * treads * rise
    rect: Rect = (-width / 2, start, width / 2, end)
    height = top + 2.8
    stone, seed = STONES[rng.integers(3)], int(rng.integers(1 << 30))
    site.floor((rect[0], start, rect[2], start + landing), 0.0, printed("tread", stone, (width, landing), seed=seed))
    starts = [start + landing + number * flight + step * run for number in range(flights) for step in range(treads)]
    for number, (z, until) in enumerate(zip(starts, [*starts[1:], end], strict=True)):
        low = (rect[0], -(number + 1) * rise, z)
        site.block(low, (rect[2], -number * rise, until), printed("tread", stone, (width, run), low, seed=seed))
        for side in (-1, 1):
            x = side * (width / 2 - 0.12)
            foot, head = (x, -(number + 1) * rise, z + 0.1), (x, -(number + 1) * rise - 0.9, z + 0.1)
            site.rod(foot, head, 0.02, printed("plain", STEEL, (1.0, 1.0)))
    panel = wall_print(2.8, rng)
    for wall in _sides(rect, height):
        site.wall(wall, panel, free=False)
        for number in range(flights):
            along = landing + number * flight + flight / 2
            along = along if wall.along[2] > 0 else wall.length - along
            site.walls.append(
                Wall(wall.at(along - flight / 2, (number + 0.5) * treads * rise, 0.0), wall.along, flight, 3.0)
            )
    for wall in _ends(rect, height):
        site.wall(wall, panel, free=False)
    site.floor(rect, -height, printed("ceiling", WHITE, (width, flight), (rect[0], 0.0, start)))
    site.unique_things(visit.get("unique", 0.5), unique_rng(visit), furniture=False)
    ground = Ground((shrunk(rect, 0.5),), (), (0.0, 0.0), 0.0, _climb(starts, rise))
    return captured("stairs", site, ground, visit)


def _climb(starts: list[float], rise: float) -> Callable[[FloatArray], FloatArray]:
    """Return the height of the treads along z."""

    def height_at(along: FloatArray) -> FloatArray:
        return np.asarray(-rise * np.searchsorted(starts, along, side="right"))

    return height_at


def _sides(rect: Rect, height: float) -> tuple[Wall, Wall]:
    """Return the walls along z: at the low x, then at the high x."""
    length = rect[3] - rect[1]
    return (
        Wall((rect[0], 0.0, rect[1]), (0.0, 0.0, 1.0), length, height),
        Wall((rect[2], 0.0, rect[3]), (0.0, 0.0, -1.0), length, height),
    )


def _ends(rect: Rect, height: float) -> tuple[Wall, Wall]:
    """Return the walls along x: at the high z, then at the low z."""
    length = rect[2] - rect[0]
    return (
        Wall((rect[0], 0.0, rect[3]), (1.0, 0.0, 0.0), length, height),
        Wall((rect[2], 0.0, rect[1]), (-1.0, 0.0, 0.0), length, height),
    )


def _slots(wall: Wall, count: int, spacing: float, out: float) -> list[Wall]:
    """Return the positions for pictures on a wall, one between each two bays."""
    return [Wall(wall.at((number + 1) * spacing - 0.75, 0.0, out), wall.along, 1.5, 2.6) for number in range(count)]
