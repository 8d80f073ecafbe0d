"""Two rooms that look the same."""

from __future__ import annotations

from typing import Literal, Unpack

import numpy as np

from tests.synthetic.paints import OAK, WHITE
from tests.synthetic.scenes import Scene
from tools.benchmarks.repeating.copies import Move
from tools.benchmarks.repeating.fittings import Site, Wall
from tools.benchmarks.repeating.prints import Print
from tools.benchmarks.repeating.visits import STONES, TILES, Visit, captured, printed, unique_rng, wall_print
from tools.benchmarks.repeating.walks import Ground, Rect

_HALF = 0.1  # half of the partition's thickness
_OPENING, _LINTEL, _HEIGHT = 1.4, 2.1, 2.7
_RIM = 0.5


def twin_rooms(
    *,
    size: tuple[float, float] = (5.0, 4.4),
    tile: float = 0.5,
    congruence: Literal["shift", "half_turn"] = "half_turn",
    **visit: Unpack[Visit],
) -> Scene:
    """Return two equally furnished rooms on either side of x = 0, connected by an open doorway.

    Each room has a closed door opposite the doorway.

    Args:
        size: size of each room along x and z.
        tile: side of a tile.
        congruence: transformation between the rooms: a shift along x, or half a turn about the doorway's centre.
        visit: see `Visit`; unique objects exist once, all others twice.
    """
    wide, deep = size
    rng = np.random.default_rng([visit.get("seed", 0), 0x2B])
    home: Rect = (-wide - _HALF, -deep / 2, -_HALF, deep / 2)
    move = Move((wide + 2 * _HALF, 0.0, 0.0)) if congruence == "shift" else Move(half_turn=True)
    room = _room(home, tile, rng)
    site = Site(
        [*room.painted, *map(move.thing, room.painted)],
        [*room.walls, *map(move.wall, room.walls)],
        [*room.obstacles, *map(move.rect, room.obstacles)],
    )
    _doorways(site, wide)
    site.unique_things(visit.get("unique", 0.5), unique_rng(visit))
    inner: Rect = (home[0] + _RIM, home[1] + _RIM, home[2] - _RIM, home[3] - _RIM)
    between: Rect = (-1.0, 0.28 - _OPENING / 2, 1.0, _OPENING / 2 - 0.28)
    ground = Ground((inner, move.rect(inner), between), tuple(site.obstacles), (0.0, 0.0), np.pi / 2)
    return captured("twin_rooms", site, ground, visit)


def _room(home: Rect, tile: float, rng: np.random.Generator) -> Site:
    """Return a room with an opening at either end and furniture; its free walls are those for unique objects."""
    site, (low_x, low_z, high_x, high_z) = Site(), home
    stone = STONES[rng.integers(3)]
    site.floor(home, 0.0, printed(TILES[rng.integers(3)], stone, (tile, tile), (low_x, 0.0, 0.0), seed=_seed(rng)))
    site.floor(home, -_HEIGHT, printed("plain", WHITE, (1.0, 1.0)))
    panel = wall_print(_HEIGHT, rng)
    side, height = high_z - _OPENING / 2, _HEIGHT
    site.wall(Wall((low_x, 0.0, high_z), (1.0, 0.0, 0.0), high_x - low_x, height), panel)
    site.wall(Wall((low_x, 0.0, _OPENING / 2), (0.0, 0.0, 1.0), side, height), panel)
    site.wall(Wall((high_x, 0.0, -_OPENING / 2), (0.0, 0.0, -1.0), side, height), panel)
    site.unique_things(0.8, rng)
    site.walls.clear()
    site.wall(Wall((high_x, 0.0, low_z), (-1.0, 0.0, 0.0), high_x - low_x, height), panel)
    site.wall(Wall((low_x, 0.0, low_z), (0.0, 0.0, 1.0), side, height), panel)
    site.wall(Wall((high_x, 0.0, high_z), (0.0, 0.0, -1.0), side, height), panel)
    for x in (low_x, high_x):
        site.flat((x, -height, -_OPENING / 2), ((0.0, 0.0, _OPENING), (0.0, height - _LINTEL, 0.0)), panel)
    return site


def _doorways(site: Site, wide: float) -> None:
    """Add the doorway's jambs, and the closed doors at the far ends of both rooms."""
    jamb = printed("plain", OAK, (1.0, 1.0))
    through = (2 * _HALF, 0.0, 0.0)
    for z in (-_OPENING / 2, _OPENING / 2):
        site.flat((-_HALF, -_LINTEL, z), (through, (0.0, _LINTEL, 0.0)), jamb)
    for y in (-_LINTEL, 0.0):
        site.flat((-_HALF, y, -_OPENING / 2), (through, (0.0, 0.0, _OPENING)), jamb)
    leaf: Print = printed("cabinet", OAK, (_OPENING, _LINTEL), (0.0, 0.0, -_OPENING / 2))
    for x, half_turn in ((-wide - _HALF, False), (wide + _HALF, True)):
        door = ((0.0, 0.0, _OPENING), (0.0, _LINTEL, 0.0))
        turned = Print(leaf.drawing, leaf.size, leaf.origin, half_turn=half_turn)
        site.flat((x, -_LINTEL, -_OPENING / 2), door, turned)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 30))
