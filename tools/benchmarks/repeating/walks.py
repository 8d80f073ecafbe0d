"""Positions of a person with a tripod in a place: scattered, along a path, or in a loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pano_mvs.core.arrays import FloatArray

Rect: TypeAlias = tuple[float, float, float, float]
Layout: TypeAlias = Literal["unordered", "path", "loop"]

LAYOUTS: tuple[Layout, ...] = ("unordered", "path", "loop")

_NEAREST, _FARTHEST = 0.6, 1.5
_CLEARANCE = 0.4
_TRIES = 1500
# Number of consecutive failures to place the next camera after which a walk is restarted.
_STUCK = 60


def _level(along: FloatArray) -> FloatArray:
    """Return the ground (N,) of a place without stairs."""
    return np.zeros(len(along))


@dataclass(frozen=True)
class Ground:
    """Where a camera can stand, seen from above.

    Attributes:
        floors: rectangles (x_low, z_low, x_high, z_high); a camera may stand in any of them.
        obstacles: rectangles from which a camera keeps a distance of 0.4.
        start: (x, z) of a position that any capture includes.
        heading_rad: direction of a path there, 0 along z, growing towards x; None: any direction.
        height_at: the y of the ground (N,) at coordinates z (N,).
    """

    floors: tuple[Rect, ...]
    obstacles: tuple[Rect, ...] = ()
    start: tuple[float, float] | None = None
    heading_rad: float | None = None
    height_at: Callable[[FloatArray], FloatArray] = _level

    def free(self, places: FloatArray) -> bool:
        """Return whether a camera may stand at all positions (N, 2) of x and z."""
        x, z = places[:, 0], places[:, 1]
        on_floor = np.zeros(len(places), bool)
        for low_x, low_z, high_x, high_z in self.floors:
            on_floor |= (x >= low_x) & (x <= high_x) & (z >= low_z) & (z <= high_z)
        for low_x, low_z, high_x, high_z in self.obstacles:
            away = np.hypot(np.maximum(low_x - x, x - high_x).clip(0), np.maximum(low_z - z, z - high_z).clip(0))
            on_floor &= away >= _CLEARANCE
        return bool(on_floor.all())


def stands(ground: Ground, layout: Layout, views: int, rng: np.random.Generator) -> FloatArray:
    """Return x and z (N, 2) of cameras, mostly 0.6 to 1.5 from the next, in the order in which they were taken.

    Args:
        ground: where cameras can stand.
        layout: "unordered": each near another one; "path": one after the other; "loop": likewise, and back to the
            start.
        views: number of cameras.
        rng: source of randomness.

    Raises:
        ValueError: if the ground is too small for this number of cameras.
    """
    walk = {"unordered": _scattered, "path": _path, "loop": _loop}[layout]
    for _ in range(_TRIES):
        found = walk(ground, views, rng)
        if found is not None:
            return found
    raise ValueError(f"the place is too small for {views} cameras, layout {layout!r}; use fewer or a larger place")


def _scattered(ground: Ground, views: int, rng: np.random.Generator) -> FloatArray | None:
    chosen, failed = [_start(ground, rng)], 0
    while len(chosen) < views and failed < _STUCK:
        near, turn = chosen[rng.integers(len(chosen))], rng.uniform(0, 2 * np.pi)
        candidate = near + rng.uniform(_NEAREST, _FARTHEST) * np.array([np.sin(turn), np.cos(turn)])
        failed += 1
        if _clear(ground, near, candidate) and _apart(candidate, chosen, _NEAREST):
            chosen.append(candidate)
            failed = 0
    return rng.permutation(np.array(chosen)) if len(chosen) == views else None


def _path(ground: Ground, views: int, rng: np.random.Generator) -> FloatArray | None:
    """Return a path through the start, extended from there in both directions."""
    start, heading = _start(ground, rng), _heading(ground, rng)
    chosen = [start]
    first_half = int(rng.integers(views // 3, views - views // 3 + 1))
    for goal, turn in ((first_half, heading), (views, heading + np.pi)):
        chosen.reverse()
        failed = 0
        while len(chosen) < goal and failed < _STUCK:
            new_turn = turn + rng.normal(0, 0.35)
            candidate = chosen[-1] + rng.uniform(_NEAREST, _FARTHEST) * np.array([np.sin(new_turn), np.cos(new_turn)])
            if _clear(ground, chosen[-1], candidate) and _apart(candidate, chosen, _NEAREST):
                chosen.append(candidate)
                turn, failed = new_turn, 0
            else:
                failed += 1
                turn += rng.normal(0, 0.3)
    return np.array(chosen) if len(chosen) == views else None


def _loop(ground: Ground, views: int, rng: np.random.Generator) -> FloatArray | None:
    """Return an ellipse or a rounded rectangle; a long and narrow one leads there and back."""
    step, half_width = rng.uniform(_NEAREST, _FARTHEST), np.exp(rng.uniform(np.log(0.2), np.log(4.0)))
    half_length = max(half_width, views * step / 4)
    heading, center = _heading(ground, rng), _start(ground, rng)
    if ground.heading_rad is None and rng.random() < 0.7:
        heading = np.pi / 2 * round(heading / (np.pi / 2))
    if rng.random() < 0.5:
        center = center + rng.uniform(-0.5, 0.5) * half_length * np.array([np.sin(heading), np.cos(heading)])
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    roundness = rng.choice([1.0, 0.5, 0.3])
    unit = np.stack([np.cos(angle), np.sin(angle)])
    along, across = np.sign(unit) * np.abs(unit) ** roundness * [[half_length], [half_width]]
    around = center + np.stack(
        [along * np.sin(heading) + across * np.cos(heading), along * np.cos(heading) - across * np.sin(heading)], axis=1
    )
    lengths = np.linalg.norm(np.roll(around, -1, axis=0) - around, axis=1)
    walked = np.cumsum(lengths) - lengths[0]
    shares = (np.arange(views) + rng.uniform(-0.1, 0.1, views)) % views / views
    chosen = around[np.searchsorted(walked, shares * walked[-1]) % len(around)] + rng.normal(0, 0.03, (views, 2))
    far = np.linalg.norm(np.roll(chosen, -1, axis=0) - chosen, axis=1)
    fits = far.max() < _FARTHEST * 1.2 and ground.free(around) and ground.free(chosen)
    return chosen if fits and all(_apart(chosen[k], list(chosen[:k]), 0.4) for k in range(1, views)) else None


def _start(ground: Ground, rng: np.random.Generator) -> FloatArray:
    if ground.start is not None:
        return np.array(ground.start) + rng.uniform(-0.05, 0.05, 2)
    for _ in range(_TRIES):
        low_x, low_z, high_x, high_z = ground.floors[rng.integers(len(ground.floors))]
        place = rng.uniform((low_x, low_z), (high_x, high_z))
        if ground.free(place[None]):
            return place
    raise ValueError("no free position was found; there are too many obstacles")


def _heading(ground: Ground, rng: np.random.Generator) -> float:
    return float(rng.uniform(0, 2 * np.pi)) if ground.heading_rad is None else ground.heading_rad


def _clear(ground: Ground, start: FloatArray, end: FloatArray) -> bool:
    """Return whether a straight walk from one position to another is free of obstacles."""
    return ground.free(start + np.linspace(0, 1, 8)[:, None] * (end - start))


def _apart(candidate: FloatArray, others: list[FloatArray], least: float) -> bool:
    return bool(min(np.hypot(*(candidate - other)) for other in others) >= least)
