"""Synthetic places with repeated structure, where images of different positions look alike, with exact ground truth.

    scene = colonnade(seed=3, unique=0.2, layout="path", views=10)
    picture, true_range = scene.view(0, (384, 768))

Lengths can be read as metres; y is down and the floor is y = 0. All places take the arguments of `Visit` and are
deterministic functions of them. `draw_capture` draws a place and all of its arguments.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tests.synthetic.scenes import Scene
from tools.benchmarks.repeating.halls import colonnade, tiled_hall
from tools.benchmarks.repeating.rows import doors, facade_row, stairs
from tools.benchmarks.repeating.twin_rooms import twin_rooms
from tools.benchmarks.repeating.visits import TILES, Visit
from tools.benchmarks.repeating.walks import LAYOUTS

__all__ = [
    "REPEATS",
    "Visit",
    "colonnade",
    "doors",
    "draw_arguments",
    "draw_capture",
    "draw_sizes",
    "facade_row",
    "stairs",
    "tiled_hall",
    "twin_rooms",
]

REPEATS: dict[str, Callable[..., Scene]] = {
    place.__name__: place for place in (tiled_hall, colonnade, facade_row, doors, twin_rooms, stairs)
}


def draw_capture(seed: int, *, views: int | None = None) -> Scene:
    """Return a capture with a random place, sizes, unique objects, layout and number of views.

    Args:
        seed: seed of the draw.
        views: number of cameras; None: 6 to 12. The size of the place grows with it.
    """
    name, arguments = draw_arguments(seed, views=views)
    return REPEATS[name](**arguments)


def draw_arguments(seed: int, *, views: int | None = None) -> tuple[str, dict[str, Any]]:
    """Return the place of `draw_capture` and its arguments; one in five has unique=0."""
    rng = np.random.default_rng([seed, 0xD4])
    name = str(rng.choice(list(REPEATS)))
    count = views or int(rng.integers(6, 13))
    visit = {
        "seed": seed,
        "views": count,
        "unique": 0.0 if rng.random() < 0.2 else round(rng.uniform(0.1, 1.0), 2),
        "layout": LAYOUTS[rng.integers(len(LAYOUTS))],
        "turned": bool(rng.random() < 0.5),
        "exposure": 0.0 if rng.random() < 0.5 else round(rng.uniform(0.03, 0.12), 3),
    }
    return name, visit | draw_sizes(name, rng, count)


def draw_sizes(name: str, rng: np.random.Generator, views: int) -> dict[str, Any]:
    """Return the size of a place for a number of views, and the other arguments that only this place has."""
    return _SIZES[name](rng, views)


def _hall(rng: np.random.Generator, views: int) -> dict[str, Any]:
    side = float(np.sqrt(views / 8))
    return {
        "size": (rng.uniform(7, 13) * side, rng.uniform(5, 9) * side),
        "tile": rng.uniform(0.3, 0.9),
        "tiles": TILES[rng.integers(3)],
        "wear": float(rng.choice([0.0, rng.uniform(0.05, 0.5)])),
        "walls": ("plain", "weak")[rng.integers(2)],
    }


def _columns(rng: np.random.Generator, views: int) -> dict[str, Any]:
    return {
        "rows": int(rng.integers(2, 4)),
        "columns": int(rng.integers(4, 8)) + views // 12,
        "spacing": rng.uniform(2.4, 4.0),
        "tile": rng.uniform(0.3, 0.9),
        "tiles": TILES[rng.integers(3)],
        "walled": bool(rng.random() < 0.6),
        "wear": float(rng.choice([0.0, rng.uniform(0.05, 0.5)])),
    }


def _lane(rng: np.random.Generator, views: int) -> dict[str, Any]:
    bay = rng.uniform(2.4, 3.6)
    return {"bays": _bays(rng, views, bay), "bay": bay, "width": rng.uniform(4.5, 9.0), "tile": rng.uniform(0.3, 0.8)}


def _corridor(rng: np.random.Generator, views: int) -> dict[str, Any]:
    bay = rng.uniform(2.3, 3.4)
    return {"bays": _bays(rng, views, bay), "bay": bay, "width": rng.uniform(2.0, 3.0), "tile": rng.uniform(0.3, 0.6)}


def _bays(rng: np.random.Generator, views: int, bay: float) -> int:
    """Return a number of bays that a path of at most `views` cameras does not cover completely."""
    return int(np.ceil(rng.uniform(1.3, 1.9) * views / bay)) + 2


def _rooms(rng: np.random.Generator, views: int) -> dict[str, Any]:
    side = max(1.0, float(np.sqrt(views / 12)))
    return {
        "size": (rng.uniform(4.6, 6.5) * side, rng.uniform(4.2, 5.5) * side),
        "tile": rng.uniform(0.3, 0.6),
        "congruence": ("shift", "half_turn")[rng.integers(2)],
    }


def _stairs(rng: np.random.Generator, views: int) -> dict[str, Any]:
    treads = int(rng.integers(7, 12))
    landing = rng.uniform(1.3, 1.8)
    flights = int(np.ceil(1.4 * views / (treads * 0.29 + landing))) + 1
    return {"flights": flights, "treads": treads, "width": rng.uniform(2.0, 3.0), "landing": landing}


_SIZES: dict[str, Callable[[np.random.Generator, int], dict[str, Any]]] = {
    "tiled_hall": _hall,
    "colonnade": _columns,
    "facade_row": _lane,
    "doors": _corridor,
    "twin_rooms": _rooms,
    "stairs": _stairs,
}
