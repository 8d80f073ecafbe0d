"""Synthetic captures of very different places with exact ground truth, to avoid tuning to a single room.

    scene = courtyard(seed=1, exposure=0.15)
    picture, true_range = scene.view(0, (256, 512))

All lengths can be read as metres. Unless `turned=False`, every camera, but no place, is rotated arbitrarily. The images
have sensor noise, drawn separately for each view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, rotation_from_quat_wxyz
from pano_mvs.testing.courtyard import courtyard_surfaces
from pano_mvs.testing.paint import BLUE, BRICK, LEAVES, OAK, RED, STEEL, STONE, WHITE, Texture
from pano_mvs.testing.room import Room, default_room, render, write_views
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Rod, Surface, Vector
from pano_mvs.testing.window_room import window_room_surfaces
from pano_mvs.testing.yard import yard_surfaces

__all__ = [
    "SCENES",
    "SKIES",
    "Scene",
    "corridor",
    "courtyard",
    "desk",
    "large_plain_room",
    "poles",
    "white_room",
    "window_room",
    "write_scene",
    "yard",
]

Painted = tuple[Surface, Texture]

# Colours at the zenith and at the horizon, and the strength of the clouds. The overcast sky is overexposed.
SKIES: dict[str, tuple[Vector, Vector, float]] = {
    "cloudy": ((0.36, 0.55, 0.86), (0.80, 0.86, 0.92), 0.35),
    "blue": ((0.22, 0.42, 0.80), (0.66, 0.78, 0.92), 0.0),
    "overcast": ((1.0, 1.0, 1.0), (0.97, 0.97, 0.98), 0.0),
    "clouds": ((0.30, 0.50, 0.85), (0.72, 0.80, 0.90), 0.8),
}


@dataclass(frozen=True)
class Scene:
    """A place and the cameras in it.

    Attributes:
        name: name of the place.
        room: the place; the true range is NaN where a ray meets no surface (the sky).
        poses: cam_from_world of each view.
        gains: (V, 3) factor of each view's red, green and blue.
        offsets: (V, 3) grey levels added to them.
        noise: standard deviation of the sensor's noise in grey levels.
        outdoor: whether only relative errors are meaningful, because ranges differ by orders of magnitude.
    """

    name: str
    room: Room
    poses: tuple[Rigid3, ...]
    gains: tuple[Vector, ...]
    offsets: tuple[Vector, ...]
    noise: float = 1.0
    outdoor: bool = False

    def view(
        self, idx: int, size_hw: tuple[int, int], *, supersample: int = 2
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the image (H, W, 3) uint8 RGB of a view and its true ranges (H, W) float32, NaN for the sky."""
        image, ranges = render(self.room, self.poses[idx], size_hw, supersample=supersample)
        rng = np.random.default_rng([self.room.seed, idx])
        levels = image * np.array(self.gains[idx]) + self.offsets[idx] + rng.normal(0, self.noise, image.shape)
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8), ranges


def courtyard(
    *, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0, sky: str = "cloudy"
) -> Scene:
    """Return a paved court of 24 × 78 under an open sky: facades, columns, trees, a van; ranges from 1.4 to 60.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, about 1.2 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: standard deviation of the logarithm of the gain of each view and colour; 0.15 is large. Offsets have a
            standard deviation of 40 grey levels times this value.
        sky: one of `SKIES`.
    """
    surfaces: list[Painted] = [(surface, "outdoor") for surface in courtyard_surfaces()]
    room = _painted("outdoor", surfaces, seed=seed, lamp=(30.0, -80.0, 25.0), sky=sky)
    return _scene(
        "courtyard", room, views=views, turned=turned, spread=(1.2, 0.25, 1.2), exposure=exposure, outdoor=True
    )


def yard(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0, sky: str = "blue") -> Scene:
    """Return a yard of 60 × 60 under an open sky that is seen behind branches, through windows and between slats.

    It is not one of `SCENES`, since the branches take long to render.

    Args:
        seed: seed of trees, textures, cameras and exposures.
        views: number of cameras, about 0.8 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
        sky: one of `SKIES`.
    """
    surfaces: list[Painted] = [(surface, "outdoor") for surface in yard_surfaces(seed)]
    room = _painted("yard", surfaces, seed=seed, lamp=(-20.0, -60.0, -30.0), sky=sky)
    return _scene("yard", room, views=views, turned=turned, spread=(0.8, 0.2, 0.8), exposure=exposure, outdoor=True)


def window_room(
    *, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0, sky: str = "overcast"
) -> Scene:
    """Return a room of 6 × 2.8 × 5 with white walls, a balcony door and two windows, through which the sky is seen.

    It is not one of `SCENES`, since its sky is for `filters.sky` alone.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, about 0.6 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
        sky: one of `SKIES`.
    """
    room = _painted("windows", list(window_room_surfaces()), seed=seed, lamp=(0.4, -1.2, 0.3), sky=sky)
    return _scene("window_room", room, views=views, turned=turned, spread=(0.7, 0.25, 0.7), exposure=exposure)


def white_room(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return a room of 6 × 2.8 × 5 with plain walls, ceiling and doors, and texture on the floor and furniture.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, about 0.6 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
    """
    surfaces: list[Painted] = [
        (Cuboid((-3.0, -1.5, -2.5), (3.0, 1.3, 2.5), WHITE), "none"),
        (Quad((-3.0, 1.299, -2.5), (6.0, 0.0, 0.0), (0.0, 0.0, 5.0), OAK), "strong"),
        (Cuboid((-0.6, -0.75, 2.46), (0.4, 1.3, 2.5), ((0.72, 0.74, 0.76), (0.72, 0.74, 0.76))), "none"),
        (Quad((-2.99, -0.6, -1.0), (0.0, 0.0, 1.1), (0.0, 0.8, 0.0), BLUE), "strong"),
        (Quad((1.0, -0.7, 2.49), (1.2, 0.0, 0.0), (0.0, 0.9, 0.0), RED), "strong"),
        (Cuboid((-2.9, 0.5, 1.5), (-1.2, 1.3, 2.4), BLUE), "weak"),
        (Cuboid((1.6, 0.5, -2.2), (2.8, 0.56, -1.2), OAK), "strong"),
        (Rod((1.7, 0.56, -2.1), (1.7, 1.3, -2.1), 0.04, OAK), "strong"),
        (Rod((2.7, 0.56, -1.3), (2.7, 1.3, -1.3), 0.04, OAK), "strong"),
        (Cuboid((-2.2, -0.4, -2.45), (-1.2, 1.3, -2.0), WHITE), "none"),
        (Ball((2.2, 0.3, -1.7), 0.2, RED), "strong"),
        (Ball((0.9, 1.05, 1.7), 0.25, LEAVES), "strong"),
    ]
    room = _painted("white", surfaces, seed=seed, lamp=(0.4, -1.2, 0.3))
    return _scene("white_room", room, views=views, turned=turned, spread=(0.6, 0.3, 0.6), exposure=exposure)


def poles(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return the furnished room with 26 rods, upright, leaning and level, most of them 2–4 px thick at 1024×512.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, about 0.5 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
    """
    rng = np.random.default_rng([seed, 0xB0])
    surfaces: list[Painted] = [(surface, "strong") for surface in default_room().surfaces]
    for number in range(26):
        azimuth, distance = 2 * np.pi * (number + rng.uniform(-0.3, 0.3)) / 26, rng.uniform(1.25, 2.2)
        x, z = distance * np.sin(azimuth), distance * np.cos(azimuth)
        lean = rng.normal(0, 0.25, 2) * (number % 3 == 0)
        foot, head = (x, 1.3, z), (x + lean[0], -1.5, z + lean[1])
        if number % 6 == 5:  # a level bar between two places
            foot, head = (x, rng.uniform(-0.6, 0.8), z), (1.3 * z, rng.uniform(-0.6, 0.8), -1.3 * x)
        # A pixel of 1024×512 is 6.1 mrad.
        radius = 0.5 * rng.uniform(2, 4) * 2 * np.pi / 1024 * distance
        surfaces.append((Rod(foot, head, float(radius), (STEEL, RED, OAK)[number % 3]), "strong"))
    room = _painted("poles", surfaces, seed=seed, lamp=(0.4, -1.2, 0.3))
    return _scene("poles", room, views=views, turned=turned, spread=(0.5, 0.25, 0.5), exposure=exposure)


def corridor(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return a corridor of 1.9 × 2.5 × 26 with doors, lamps and pipes, and a row of cameras along it.

    The baselines are parallel to the corridor: its far end is near the epipoles, where range is difficult to measure.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, 0.6–0.9 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
    """
    surfaces: list[Painted] = [
        (Cuboid((-0.95, -1.1, -8.0), (0.95, 1.4, 18.0), STONE), "weak"),
        (Quad((-0.95, 1.399, -8.0), (1.9, 0.0, 0.0), (0.0, 0.0, 26.0), OAK), "strong"),
        (Rod((0.85, -1.0, -8.0), (0.85, -1.0, 18.0), 0.05, STEEL), "strong"),
        (Rod((-0.88, -0.95, -8.0), (-0.88, -0.95, 18.0), 0.03, RED), "strong"),
        (Cuboid((-0.95, 0.4, 3.0), (-0.5, 1.4, 3.9), BLUE), "strong"),
    ]
    for number, z in enumerate((-6.0, -2.5, 1.0, 4.5, 8.0, 11.5, 15.0)):
        side = 0.95 if number % 2 else -0.95
        frame = (min(side, 0.9 * side), -0.65, z), (max(side, 0.9 * side), 1.4, z + 0.9)
        surfaces.append((Cuboid(*frame, (OAK, BLUE, BRICK)[number % 3]), "strong"))
        surfaces.append((Cuboid((-0.3, -1.1, z + 1.6), (0.3, -1.03, z + 1.8), WHITE), "none"))
    room = _painted("corridor", surfaces, seed=seed, lamp=(0.2, -1.0, 2.0))
    rng = np.random.default_rng([seed, 0xC0])
    along = np.concatenate([[0.0], np.cumsum(rng.uniform(0.6, 0.9, max(0, views - 1)))])
    centers = np.stack([rng.uniform(-0.15, 0.15, views), rng.uniform(-0.1, 0.1, views), along], axis=1)
    return _scene("corridor", room, views=views, turned=turned, centers=centers, exposure=exposure)


def desk(
    *,
    seed: int = 0,
    views: int = 4,
    turned: bool = True,
    exposure: float = 0.0,
    reach: float = 1.0,
    top: Texture = "strong",
) -> Scene:
    """Return a room of 6 × 2.9 × 5 with cameras 0.42 above a large desk: the baselines are longer than that.

    Straight below the cameras, most sources see the desk at 45–80° from the reference's direction.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, about 0.9 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
        reach: factor of the distances between the cameras; with 1.6, the desk is at 0.2 to 0.5 baselines.
        top: texture of the desk top.
    """
    surfaces: list[Painted] = [
        (Cuboid((-3.0, -1.7, -2.5), (3.0, 1.2, 2.5), STONE), "strong"),
        (Cuboid((-1.8, 0.42, -1.1), (1.8, 0.46, 1.1), OAK), top),
        (Cuboid((-1.2, 0.36, 0.3), (-0.9, 0.42, 0.7), BLUE), "strong"),
        (Cuboid((0.5, 0.37, -0.6), (0.75, 0.42, -0.2), BRICK), "strong"),
        (Ball((0.2, 0.39, 0.75), 0.03, LEAVES), "strong"),
        (Rod((1.3, 0.42, 0.5), (1.3, -0.1, 0.5), 0.015, STEEL), "strong"),
        (Ball((1.3, -0.15, 0.5), 0.09, RED), "strong"),
        (Cuboid((2.0, 0.3, -2.4), (2.8, 1.2, -1.0), BLUE), "strong"),
    ]
    surfaces += [
        (Rod((x, 0.46, z), (x, 1.2, z), 0.04, OAK), "strong") for x, z in ((-1.6, -0.9), (1.6, -0.9), (1.6, 0.9))
    ]
    room = _painted("desk", surfaces, seed=seed, lamp=(0.4, -1.4, 0.3))
    spread = 0.9 * reach, 0.06 * reach, 0.6 * reach
    return _scene("desk", room, views=views, turned=turned, spread=spread, exposure=exposure)


def plain_table(
    *, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0, height: float = 0.4
) -> Scene:
    """Return a room of 6 × 2.9 × 5 with cameras above a large table that has hardly any texture, and nothing on it.

    All other surfaces are farther away. It is not one of `SCENES`, since it is for near limits alone.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, about 0.9 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
        height: of the cameras above the table.
    """
    surfaces: list[Painted] = [
        (Cuboid((-3.0, -1.7, -2.5), (3.0, 1.2, 2.5), STONE), "strong"),
        (Cuboid((-1.6, height, -1.1), (1.6, height + 0.04, 1.1), OAK), "faint"),
        (Cuboid((2.0, 0.3, -2.4), (2.8, 1.2, -1.0), BLUE), "strong"),
        (Cuboid((-2.8, -0.3, 1.4), (-2.0, 1.2, 2.4), BRICK), "strong"),
    ]
    room = _painted("table", surfaces, seed=seed, lamp=(0.4, -1.4, 0.3))
    return _scene("plain_table", room, views=views, turned=turned, spread=(0.9, 0.06, 0.6), exposure=exposure)


def weak_room(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return the furnished room of `pano_mvs.testing.room` with its nearly plain texture.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, about 0.6 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
    """
    room = default_room(seed, "weak")
    return _scene("weak_room", room, views=views, turned=turned, spread=(0.6, 0.3, 0.6), exposure=exposure)


def large_plain_room(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return a nearly empty room of 12 × 4 × 9: plain walls and ceiling, a faint floor, a few small objects.

    Most key points are coarse, faint and few, so that they determine poses poorly. It is not one of `SCENES`, since
    most of its surfaces have no texture at all and no reliable ranges.

    Args:
        seed: seed of textures, cameras and exposures.
        views: number of cameras, about 1.5 apart.
        turned: whether every camera is rotated arbitrarily.
        exposure: as in `courtyard`.
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
    room = _painted("large plain room", surfaces, seed=seed, lamp=(1.0, -1.2, 0.8))
    return _scene("large_plain_room", room, views=views, turned=turned, spread=(2.0, 0.4, 2.0), exposure=exposure)


SCENES: dict[str, Callable[..., Scene]] = {
    scene.__name__: scene for scene in (courtyard, white_room, poles, corridor, weak_room, desk)
}


def write_scene(folder: Path, scene: Scene, size_hw: tuple[int, int]) -> None:
    """Write all views of a scene as a capture with ground truth, like `pano_mvs.testing.room.write_capture`."""
    write_views(folder, (scene.view(idx, size_hw) for idx in range(len(scene.poses))), scene.poses)


def _painted(name: str, surfaces: list[Painted], *, seed: int, lamp: Vector, sky: str | None = None) -> Room:
    """Return a room of surfaces with a texture each, which depend on the name of the room; `sky` is one of `SKIES`."""
    zenith, horizon, clouds = SKIES[sky] if sky else ((0.0,) * 3, (0.0,) * 3, 0.0)
    own = seed + sum(map(ord, name))
    return Room(
        tuple(surface for surface, _ in surfaces),
        seed=own,
        lamp=lamp,
        textures=tuple(texture for _, texture in surfaces),
        sky=(zenith, horizon) if sky else None,
        clouds=clouds,
    )


def _scene(
    name: str,
    room: Room,
    *,
    views: int,
    turned: bool,
    exposure: float,
    spread: Vector = (0.0, 0.0, 0.0),
    centers: NDArray[np.float64] | None = None,
    outdoor: bool = False,
) -> Scene:
    """Return a scene with its cameras, at given centres or drawn from a box, the first in its centre."""
    rng = np.random.default_rng([room.seed, 0xCA])
    if centers is None:
        centers = _apart(rng, views, np.array(spread))
    turns = [rotation_from_quat_wxyz(rng.normal(size=4)) if turned else np.eye(3) for _ in range(views)]
    gains, offsets = np.exp(exposure * rng.normal(size=(views, 3))), 40 * exposure * rng.normal(size=(views, 3))
    return Scene(
        name,
        room,
        tuple(Rigid3.from_center(turn, center) for turn, center in zip(turns, centers, strict=True)),
        tuple((float(r), float(g), float(b)) for r, g, b in gains),
        tuple((float(r), float(g), float(b)) for r, g, b in offsets),
        outdoor=outdoor,
    )


def _apart(rng: np.random.Generator, count: int, spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return centres (N, 3) within ±spread, the first at the origin, no two closer than 1.2 spread / √N."""
    chosen = [np.zeros(3)]
    least = 1.2 * float(spread.max()) / np.sqrt(count)
    while len(chosen) < count:
        candidate = rng.uniform(-spread, spread)
        if min(float(np.linalg.norm(candidate - other)) for other in chosen) > least:
            chosen.append(candidate)
    return np.array(chosen[:count])
