"""Synthetic captures of very different places with exact ground truth, to avoid tuning to a single room.

    scene = courtyard(seed=1, exposure=0.15)
    picture, true_range = scene.view(0, (256, 512))

All lengths can be read as metres. Unless `turned=False`, every camera, but no place, is rotated arbitrarily. The images
have sensor noise, drawn separately for each view. All scenes take the same settings:

Args:
    seed: seed of textures, cameras and exposures.
    views: number of cameras.
    turned: whether every camera is rotated arbitrarily.
    exposure: standard deviation of the logarithm of the gain of each view and colour; 0.15 is large. Offsets have a
        standard deviation of 40 grey levels times this value.
    sky: one of `SKIES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, rotation_from_quat_wxyz
from pano_mvs.testing.room import Room, Texture, default_room, render
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Surface, Vector
from tests.synthetic.capture_files import write_views
from tests.synthetic.paints import BLUE, BRICK, LEAVES, OAK, RED, STEEL, STONE, WHITE
from tests.synthetic.rod import Rod

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
    """Return a paved court of 24 × 78 under an open sky: facades, columns, trees, a van; ranges from 1.4 to 60."""
    surfaces: list[Painted] = [
        (surface, "outdoor") for surface in (*_buildings(), *_arcade(), *_trees(), *_street_furniture())
    ]
    room = painted("outdoor", surfaces, seed=seed, lamp=(30.0, -80.0, 25.0), sky=sky)
    return placed(
        "courtyard", room, views=views, turned=turned, spread=(1.2, 0.25, 1.2), exposure=exposure, outdoor=True
    )


def white_room(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return a room of 6 × 2.8 × 5 with plain walls, ceiling and doors, and texture on the floor and furniture."""
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
    room = painted("white", surfaces, seed=seed, lamp=(0.4, -1.2, 0.3))
    return placed("white_room", room, views=views, turned=turned, spread=(0.6, 0.3, 0.6), exposure=exposure)


def poles(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return the furnished room with 26 rods, upright, leaning and level, most of them 2–4 px thick at 1024×512."""
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
    room = painted("poles", surfaces, seed=seed, lamp=(0.4, -1.2, 0.3))
    return placed("poles", room, views=views, turned=turned, spread=(0.5, 0.25, 0.5), exposure=exposure)


def corridor(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return a corridor of 1.9 × 2.5 × 26 with doors, lamps and pipes, and a row of cameras along it.

    The baselines are parallel to the corridor: its far end is near the epipoles, where range is difficult to measure.
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
    room = painted("corridor", surfaces, seed=seed, lamp=(0.2, -1.0, 2.0))
    rng = np.random.default_rng([seed, 0xC0])
    along = np.concatenate([[0.0], np.cumsum(rng.uniform(0.6, 0.9, max(0, views - 1)))])
    centers = np.stack([rng.uniform(-0.15, 0.15, views), rng.uniform(-0.1, 0.1, views), along], axis=1)
    return placed("corridor", room, views=views, turned=turned, centers=centers, exposure=exposure)


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
    room = painted("desk", surfaces, seed=seed, lamp=(0.4, -1.4, 0.3))
    spread = 0.9 * reach, 0.06 * reach, 0.6 * reach
    return placed("desk", room, views=views, turned=turned, spread=spread, exposure=exposure)


def weak_room(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return the furnished room of `pano_mvs.testing.room` with its nearly plain texture."""
    room = default_room(seed, "weak")
    return placed("weak_room", room, views=views, turned=turned, spread=(0.6, 0.3, 0.6), exposure=exposure)


SCENES: dict[str, Callable[..., Scene]] = {
    scene.__name__: scene for scene in (courtyard, white_room, poles, corridor, weak_room, desk)
}


def write_scene(folder: Path, scene: Scene, size_hw: tuple[int, int]) -> None:
    """Write all views of a scene as a capture with ground truth, like `write_capture`."""
    write_views(folder, (scene.view(idx, size_hw) for idx in range(len(scene.poses))), scene.poses)


def painted(name: str, surfaces: list[Painted], *, seed: int, lamp: Vector, sky: str | None = None) -> Room:
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


def placed(
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
