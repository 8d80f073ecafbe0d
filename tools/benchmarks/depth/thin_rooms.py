"""Rooms with thin objects, whose thickness is given in pixels, and the pixels that show these objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pano_mvs.testing.room import Texture, default_room, render
from pano_mvs.testing.surfaces import Cuboid, Surface
from tests.synthetic.paints import BLUE, OAK, RED, STEEL
from tests.synthetic.rod import Rod
from tests.synthetic.scenes import Scene, poles

__all__ = ["THIN_KINDS", "thin_pixels", "thin_scene"]

Painted = tuple[Surface, Texture]
_COLORS = STEEL, RED, OAK, BLUE
# A thin pixel differs by more than this share of its range from what is behind the thin objects.
_STEP = 0.05


def thin_scene(
    kind: str, *, width: int, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0
) -> Scene:
    """Return the furnished room of `pano_mvs.testing.room` with thin objects.

    Args:
        kind: "wires" without texture at all slopes, 2 to 6 pixels thick; "legs" of tables and chairs, 2 to 4 pixels;
            "bars" of gratings, 2 to 3 pixels; or "treads" of open stairs, whose edges are 2 to 4 pixels high.
        width: columns of the panorama to which the thickness refers.
        seed: seed of the objects, textures, cameras and exposures.
        views: number of cameras, about 0.5 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `tests.synthetic.scenes.courtyard`.
    """
    base = poles(seed=seed, views=views, turned=turned, exposure=exposure)
    objects = THIN_KINDS[kind](np.random.default_rng([seed, 0x71]), 2 * np.pi / width)
    surfaces = default_room().surfaces
    room = dataclasses.replace(
        base.room,
        surfaces=(*surfaces, *(surface for surface, _ in objects)),
        textures=(*base.room.textures[: len(surfaces)], *(texture for _, texture in objects)),
    )
    return dataclasses.replace(base, name=f"thin_{kind}", room=room)


def thin_pixels(scene: Scene, idx: int, truth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels of a view, (H, W), that show what stands in the furnished room.

    Args:
        scene: a scene of `thin_scene`, or `tests.synthetic.scenes.poles`.
        idx: number of the view.
        truth: (H, W) its true ranges.
    """
    count = len(default_room().surfaces)
    surfaces, textures = scene.room.surfaces[:count], scene.room.textures[:count]
    empty = dataclasses.replace(scene.room, surfaces=surfaces, textures=textures)
    behind = render(empty, scene.poses[idx], (truth.shape[0], truth.shape[1]), supersample=1)[1]
    return np.asarray(np.abs(behind - truth) > _STEP * truth)


def _wires(rng: np.random.Generator, pixel: float) -> list[Painted]:
    """Return plain cords at all slopes."""
    wires: list[Painted] = []
    for number in range(24):
        azimuth, distance = 2 * np.pi * (number + rng.uniform(-0.3, 0.3)) / 24, rng.uniform(1.2, 2.1)
        middle = distance * np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
        middle[1] = rng.uniform(-0.6, 0.6)
        aside = np.cross(middle / np.linalg.norm(middle), (0.0, 1.0, 0.0))
        slope = rng.uniform(-0.5, 0.5) * np.pi
        along = np.cos(slope) * aside + np.sin(slope) * np.array([0.0, 1.0, 0.0]) + rng.normal(0, 0.15, 3)
        half = rng.uniform(0.4, 0.7) * along / np.linalg.norm(along)
        radius = 0.5 * rng.uniform(2, 6) * pixel * distance
        wires.append((_rod(middle - half, middle + half, radius=radius, number=number), "none"))
    return wires


def _legs(rng: np.random.Generator, pixel: float) -> list[Painted]:
    """Return tables and chairs: four thin legs under a slab, and two posts of the back of a chair."""
    legs: list[Painted] = []
    for number in range(7):
        azimuth, distance = 2 * np.pi * (number + rng.uniform(-0.2, 0.2)) / 7, rng.uniform(1.5, 1.9)
        x, z = distance * np.sin(azimuth), distance * np.cos(azimuth)
        side, top = rng.uniform(0.18, 0.3), rng.uniform(0.55, 0.8)
        radius = 0.5 * rng.uniform(2, 4) * pixel * distance
        for number_of_leg, (right, front) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
            corner = np.array([x + right * side, top, z + front * side])
            head = corner - (0, 0.6 if number_of_leg < 2 and number % 2 else 0, 0)
            legs.append((_rod(corner * (1, 0, 1) + (0, 1.3, 0), head, radius=radius, number=number), "strong"))
        low, high = (x - side, top, z - side), (x + side, top + 2 * radius, z + side)
        legs.append((Cuboid(low, high, _COLORS[number % 4]), "strong"))
    return legs


def _bars(rng: np.random.Generator, pixel: float) -> list[Painted]:
    """Return four gratings of parallel bars, upright or level, in front of the walls."""
    bars: list[Painted] = []
    for side in range(4):
        turn = np.pi / 2 * side + rng.uniform(-0.2, 0.2)
        ahead, aside = np.array([np.sin(turn), 0, np.cos(turn)]), np.array([np.cos(turn), 0, -np.sin(turn)])
        distance, up = rng.uniform(1.4, 1.8), np.array([0.0, 1.0, 0.0])
        radius = 0.5 * rng.uniform(2, 3) * pixel * distance
        across, along = (aside, up) if side % 2 else (up, aside)
        for step in np.arange(-4, 5).tolist():
            middle = distance * ahead + rng.uniform(0.12, 0.14) * step * across
            bars.append((_rod(middle - 0.6 * along, middle + 0.6 * along, radius=radius, number=side), "strong"))
    return bars


def _treads(rng: np.random.Generator, pixel: float) -> list[Painted]:
    """Return three flights of thin treads that ascend, with thin strings."""
    treads: list[Painted] = []
    for flight in range(3):
        turn = 2 * np.pi * (flight + rng.uniform(-0.2, 0.2)) / 3
        x, z = 1.7 * np.sin(turn), 1.7 * np.cos(turn)
        thickness = rng.uniform(2, 4) * pixel * 1.7
        for step in range(9):
            y, way = 1.1 - 0.24 * step, 0.14 * (step - 4)
            place = (x + way, z) if abs(np.cos(turn)) > abs(np.sin(turn)) else (x, z + way)
            low = (place[0] - 0.14, y, place[1] - 0.14)
            high = (place[0] + 0.14, y + thickness, place[1] + 0.14)
            treads.append((Cuboid(low, high, _COLORS[flight]), "strong"))
    return treads


def _rod(foot: NDArray[np.float64], head: NDArray[np.float64], *, radius: float, number: int) -> Rod:
    ends = [(float(end[0]), float(end[1]), float(end[2])) for end in (foot, head)]
    return Rod(ends[0], ends[1], float(radius), _COLORS[number % 4])


THIN_KINDS: dict[str, Callable[[np.random.Generator, float], list[Painted]]] = {
    "wires": _wires,
    "legs": _legs,
    "bars": _bars,
    "treads": _treads,
}
