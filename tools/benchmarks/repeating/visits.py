"""Common parts of captures of repeating places: cameras, exposure, appearance of floors and walls."""

from __future__ import annotations

from typing import Literal, TypedDict

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, rotation_from_quat_wxyz, rotation_from_rotvec
from pano_mvs.testing.room import Colors, Room
from pano_mvs.testing.surfaces import Vector
from tests.synthetic.scenes import Scene
from tools.benchmarks.repeating.drawings import Drawing, Kind
from tools.benchmarks.repeating.fittings import Site
from tools.benchmarks.repeating.prints import Print
from tools.benchmarks.repeating.walks import Ground, Layout, Rect, stands

Tiles = Literal["marble", "checker", "motif"]

TILES: tuple[Tiles, ...] = ("marble", "checker", "motif")
MARBLE: Colors = ((0.80, 0.77, 0.71), (0.62, 0.60, 0.57))
SAND: Colors = ((0.72, 0.66, 0.55), (0.60, 0.55, 0.47))
SLATE: Colors = ((0.46, 0.48, 0.50), (0.34, 0.36, 0.39))
PLASTER: Colors = ((0.84, 0.82, 0.77), (0.60, 0.52, 0.42))
STONES = (MARBLE, SAND, SLATE)

_SKY = ((0.36, 0.55, 0.86), (0.80, 0.86, 0.92))
# Distance of the lamp, so large that equal objects have equal shading.
_LAMP = (3.1e5, -1e6, 4.7e5)
_PANEL = 1.2


class Visit(TypedDict, total=False):
    """How a place is photographed, and the share of unique objects.

    Attributes:
        seed: seed of everything random; the default is 0.
        views: number of cameras; the default is 8.
        unique: share in [0, 1] of the positions for pictures and furniture that unique ones occupy. With 0, only the
            ends of the place are unique; the default is 0.5.
        layout: "unordered" (the cameras are shuffled), "path" or "loop"; the default is "unordered".
        turned: whether every camera is rotated arbitrarily, or is upright within about a degree and rotated about the
            vertical only; the default is true.
        exposure: approximate drift of the logarithm of the exposure during the capture; the default is 0.
    """

    seed: int
    views: int
    unique: float
    layout: Layout
    turned: bool
    exposure: float


def captured(name: str, site: Site, ground: Ground, visit: Visit, *, sky: bool = False) -> Scene:
    """Return a place with its cameras, on a tripod with a height of 1.3 to 1.7 that varies by 2 cm.

    Args:
        name: name of the place.
        site: the surfaces that have been built.
        ground: where cameras may stand.
        visit: how it is photographed.
        sky: whether there is a sky where nothing has been built.
    """
    seed, views = visit.get("seed", 0), visit.get("views", 8)
    rng = np.random.default_rng([seed, sum(map(ord, name)), 0xCA])
    room = Room(
        tuple(surface for surface, _ in site.painted),
        seed=seed + sum(map(ord, name)),
        lamp=_LAMP,
        textures=tuple(texture for _, texture in site.painted),
        sky=_SKY if sky else None,
    )
    places = stands(ground, visit.get("layout", "unordered"), views, rng)
    heights = rng.uniform(1.3, 1.7) + rng.normal(0, 0.02, views).clip(-0.06, 0.06)
    centers = np.stack([places[:, 0], ground.height_at(places[:, 1]) - heights, places[:, 1]], axis=1)
    turns = [_any_turn(rng) if visit.get("turned", True) else _upright(rng) for _ in range(views)]
    gains = _drift(rng, views, visit.get("exposure", 0.0))
    return Scene(
        name,
        room,
        tuple(Rigid3.from_center(turn, center) for turn, center in zip(turns, centers, strict=True)),
        tuple((float(red), float(green), float(blue)) for red, green, blue in gains),
        ((0.0, 0.0, 0.0),) * views,
        outdoor=sky,
    )


def printed(
    kind: Kind, colors: Colors, size: tuple[float, float], origin: Vector = (0.0, 0.0, 0.0), *, seed: int = 0
) -> Print:
    """Return a drawing printed periodically from an origin; the large kinds have finer texels."""
    return Print(Drawing(kind, colors, seed, 512 if kind in ("bay", "door") else 256), size, origin)


def floor_print(tile: float, tiles: Tiles, rng: np.random.Generator, *, wear: float = 0.0) -> Print:
    """Return a tiled floor of a random stone; it repeats after one tile, after two if it is chequered."""
    period = tile * (2 if tiles == "checker" else 1)
    drawing = Drawing(tiles, STONES[rng.integers(3)], int(rng.integers(1 << 30)), 512 if tiles == "checker" else 256)
    return Print(drawing, (period, period), wear=wear, seed=int(rng.integers(1 << 30)))


def wall_print(height: float, rng: np.random.Generator, *, wear: float = 0.0) -> Print:
    """Return plaster in panels, which are equal except for the wear."""
    drawing = Drawing("wall", PLASTER, int(rng.integers(1 << 30)))
    return Print(drawing, (_PANEL, height), wear=wear, seed=int(rng.integers(1 << 30)))


def shrunk(rect: Rect, by: float = 0.55) -> Rect:
    """Return a rectangle without a margin."""
    return rect[0] + by, rect[1] + by, rect[2] - by, rect[3] - by


def unique_rng(visit: Visit) -> np.random.Generator:
    """Return the generator for unique objects; the rest of the place does not depend on their number."""
    return np.random.default_rng([visit.get("seed", 0), 0x51])


def _any_turn(rng: np.random.Generator) -> FloatArray:
    return rotation_from_quat_wxyz(rng.normal(size=4))


def _upright(rng: np.random.Generator) -> FloatArray:
    tilt = rotation_from_rotvec(np.radians(0.7) * rng.normal(size=3) * (1, 0, 1))
    return tilt @ rotation_from_rotvec((0.0, rng.uniform(-np.pi, np.pi), 0.0))


def _drift(rng: np.random.Generator, views: int, exposure: float) -> FloatArray:
    """Return the gain of each view and colour (V, 3): a random walk, in which the colours differ by a quarter."""
    steps = rng.normal(size=(views, 1)) + 0.25 * rng.normal(size=(views, 3))
    walk = np.cumsum(steps, axis=0) / np.sqrt(max(views, 1))
    return np.asarray(np.exp(exposure * (walk - walk.mean(axis=0))))
