"""Places with and without a sky, of many kinds, to which the models of `filters.sky` are fitted.

Each kind draws its dimensions, colours, sky and exposures from a seed, so that no two places of a kind are equal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pano_mvs.testing.room import Colors, Room, Texture, default_room
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Vector
from tests.synthetic.paints import BLUE, BRICK, LEAVES, OAK, RED, STEEL, STONE, WHITE
from tests.synthetic.places import large_plain_room, window_room, yard
from tests.synthetic.rod import Rod
from tests.synthetic.scenes import SKIES, Painted, Scene, corridor, courtyard, placed, white_room

DAY = {
    **SKIES,
    "grey": ((0.62, 0.63, 0.65), (0.74, 0.75, 0.76), 0.15),
    "hazy": ((0.60, 0.72, 0.90), (0.93, 0.94, 0.95), 0.0),
    "sunset": ((0.30, 0.36, 0.60), (0.98, 0.62, 0.34), 0.3),
}
NIGHT = {"night": ((0.02, 0.03, 0.06), (0.10, 0.09, 0.08), 0.0)}
PALE: Colors = ((0.80, 0.84, 0.88), (0.78, 0.82, 0.87))
TILES: Colors = ((0.88, 0.87, 0.85), (0.80, 0.80, 0.79))
GLOOM: Colors = ((0.10, 0.10, 0.12), (0.08, 0.08, 0.10))


def _scene(
    name: str,
    surfaces: list[Painted],
    rng: np.random.Generator,
    *,
    skies: dict[str, tuple[Vector, Vector, float]],
    lamp: Vector,
    spread: Vector,
    gain: float = 1.0,
) -> Scene:
    zenith, horizon, clouds = skies[str(rng.choice(list(skies)))]
    seed = int(rng.integers(1 << 16))
    room = Room(
        tuple(one for one, _ in surfaces),
        seed=seed,
        lamp=lamp,
        textures=tuple(one for _, one in surfaces),
        sky=(zenith, horizon),
        clouds=clouds,
    )
    exposure = float(rng.choice([0.0, 0.0, 0.05, 0.12]))
    scene = placed(name, room, views=4, turned=bool(rng.random() < 0.3), spread=spread, exposure=exposure)
    return _brighter(scene, gain)


def _brighter(scene: Scene, gain: float) -> Scene:
    return replace(scene, gains=tuple((gain * r, gain * g, gain * b) for r, g, b in scene.gains))


def _pick(rng: np.random.Generator, *paints: Colors) -> Colors:
    return paints[int(rng.integers(len(paints)))]


def _kind_of_paint(rng: np.random.Generator, *textures: Texture) -> Texture:
    return textures[int(rng.integers(len(textures)))]


def _clutter(rng: np.random.Generator, *, floor: float, low: float, high: float, number: int) -> list[Painted]:
    """Return boxes, balls and posts that stand on the floor between two distances from the first camera."""
    found: list[Painted] = []
    for _ in range(number):
        azimuth, distance = rng.uniform(0, 2 * np.pi), rng.uniform(low, high)
        x, z, size = distance * np.sin(azimuth), distance * np.cos(azimuth), 0.12 * distance * rng.uniform(0.5, 1.5)
        paint = _pick(rng, OAK, BLUE, RED, LEAVES, BRICK)
        shape = rng.integers(3)
        if shape == 0:
            found.append((Cuboid((x - size, floor - 2 * size, z - size), (x + size, floor, z + size), paint), "strong"))
        elif shape == 1:
            found.append((Ball((x, floor - size, z), size, paint), "strong"))
        else:
            found.append((Rod((x, floor, z), (x, floor - 4 * size, z), 0.12 * size, paint), "strong"))
    return found


def court(rng: np.random.Generator) -> Scene:
    """Return the courtyard under a drawn sky."""
    return _under(courtyard(seed=int(rng.integers(1 << 16)), exposure=float(rng.choice([0.0, 0.1]))), rng, DAY)


def trees(rng: np.random.Generator) -> Scene:
    """Return the yard with trees under a drawn sky."""
    return _under(yard(seed=int(rng.integers(1 << 16)), exposure=float(rng.choice([0.0, 0.1]))), rng, DAY)


def windows(rng: np.random.Generator) -> Scene:
    """Return the white room with windows and a balcony door."""
    scene = window_room(seed=int(rng.integers(1 << 16)), exposure=float(rng.choice([0.0, 0.05])))
    return _brighter(_under(scene, rng, DAY), float(rng.choice([1.0, 1.2])))


def _under(scene: Scene, rng: np.random.Generator, skies: dict[str, tuple[Vector, Vector, float]]) -> Scene:
    zenith, horizon, clouds = skies[str(rng.choice(list(skies)))]
    return replace(scene, room=replace(scene.room, sky=(zenith, horizon), clouds=clouds))


def terrace(rng: np.random.Generator) -> Scene:
    """Return a terrace: plain tiles, a house wall behind, a parapet or a railing around, often overexposed."""
    wide, deep, floor = rng.uniform(3, 6), rng.uniform(2.5, 5), rng.uniform(1.2, 1.7)
    parapet = floor - rng.uniform(0.6, 1.1)
    tiles = _pick(rng, TILES, STONE, PALE)
    surfaces: list[Painted] = [
        (
            Quad((-wide, floor, -deep), (2 * wide, 0, 0), (0, 0, 2 * deep), tiles),
            _kind_of_paint(rng, "faint", "weak", "none"),
        ),
        (
            Cuboid(
                (-wide, floor - rng.uniform(2.5, 6), -deep - 3), (wide, floor, -deep), _pick(rng, WHITE, STONE, BRICK)
            ),
            _kind_of_paint(rng, "weak", "outdoor", "faint"),
        ),
        (Cuboid((-0.8, floor - 2.1, -deep - 0.05), (0.6, floor, -deep + 0.05), _pick(rng, BLUE, OAK)), "strong"),
        (
            Cuboid((-wide, parapet, deep), (wide, floor, deep + 0.2), WHITE),
            _kind_of_paint(rng, "faint", "weak", "none"),
        ),
        (Quad((-90, floor + 8, -90), (180, 0, 0), (0, 0, 180), LEAVES), "outdoor"),
    ]
    for side in (-wide, wide):
        surfaces += [
            (Rod((side, floor, z), (side, parapet, z), 0.03, STEEL), "strong") for z in np.linspace(-deep, deep, 6)
        ]
        surfaces.append((Rod((side, parapet, -deep), (side, parapet, deep), 0.04, STEEL), "strong"))
    if rng.random() < 0.5:  # an awning
        surfaces.append(
            (
                Quad((-wide, floor - 2.4, -deep), (2 * wide, 0, 0), (0, 0.4, 0.8 * deep), _pick(rng, WHITE, RED)),
                _kind_of_paint(rng, "none", "weak"),
            )
        )
    surfaces += _clutter(rng, floor=floor, low=1.3, high=min(wide, deep), number=5)
    surfaces += _houses(rng, ground=floor + 8, number=6)
    return _scene(
        "terrace",
        surfaces,
        rng,
        skies=DAY,
        lamp=(8.0, -20.0, 6.0),
        spread=(0.8, 0.2, 0.8),
        gain=float(rng.choice([1.0, 1.2, 1.5])),
    )


def _houses(rng: np.random.Generator, *, ground: float, number: int) -> list[Painted]:
    found: list[Painted] = []
    for azimuth in rng.uniform(0, 2 * np.pi, number):
        distance, size = rng.uniform(18, 60), rng.uniform(4, 9)
        x, z, top = distance * np.sin(azimuth), distance * np.cos(azimuth), ground - rng.uniform(5, 16)
        paint = _pick(rng, BRICK, STONE, WHITE)
        found.append((Cuboid((x - size, top, z - size), (x + size, ground, z + size), paint), "outdoor"))
    return found


def balcony(rng: np.random.Generator) -> Scene:
    """Return a loggia: floor, ceiling and three walls that are nearly plain, open to the sky on one side."""
    wide, deep, floor, top = rng.uniform(1.6, 3), rng.uniform(1.2, 2), rng.uniform(1.2, 1.6), -rng.uniform(0.9, 1.5)
    plain = _kind_of_paint(rng, "none", "faint", "weak")
    paint = _pick(rng, WHITE, PALE, STONE)
    surfaces: list[Painted] = [
        (Cuboid((-wide, top - 0.2, -deep), (wide, top, deep), paint), plain),
        (
            Cuboid((-wide, floor, -deep), (wide, floor + 0.2, deep), _pick(rng, TILES, OAK)),
            _kind_of_paint(rng, "weak", "strong"),
        ),
        (Cuboid((-wide, top, -deep - 0.2), (wide, floor, -deep), paint), plain),
        (Cuboid((-wide - 0.2, top, -deep), (-wide, floor, deep), paint), plain),
        (Cuboid((wide, top, -deep), (wide + 0.2, floor, deep), paint), plain),
        (Quad((-90, floor + 6, -90), (180, 0, 0), (0, 0, 180), STONE), "outdoor"),
        (Rod((-wide, floor - 1.0, deep), (wide, floor - 1.0, deep), 0.03, STEEL), "strong"),
        (Quad((-0.5, top + 0.5, -deep + 0.01), (0.9, 0, 0), (0, 1.0, 0), _pick(rng, BLUE, RED, LEAVES)), "strong"),
    ]
    surfaces += [
        (Rod((x, floor, deep), (x, floor - 1.0, deep), 0.02, STEEL), "strong") for x in np.linspace(-wide, wide, 8)
    ]
    surfaces += _clutter(rng, floor=floor, low=0.9, high=min(wide, deep), number=4)
    surfaces += _houses(rng, ground=floor + 6, number=14)
    return _scene(
        "balcony",
        surfaces,
        rng,
        skies=DAY,
        lamp=(2.0, -4.0, 8.0),
        spread=(0.6, 0.2, 0.5),
        gain=float(rng.choice([1.0, 1.25])),
    )


def hall(rng: np.random.Generator) -> Scene:
    """Return a hall with roof lights: long openings in a plain ceiling, through which only the sky is seen."""
    wide, deep, floor, top = rng.uniform(5, 9), rng.uniform(8, 14), 1.6, -rng.uniform(3, 6)
    plain, paint = _kind_of_paint(rng, "none", "faint", "weak"), _pick(rng, WHITE, PALE, STONE)
    number, share = int(rng.integers(2, 5)), rng.uniform(0.25, 0.6)
    pitch = 2 * wide / number
    surfaces: list[Painted] = [
        (
            Quad((-wide, floor, -deep), (2 * wide, 0, 0), (0, 0, 2 * deep), _pick(rng, OAK, STONE)),
            _kind_of_paint(rng, "strong", "weak"),
        ),
        *((Cuboid((x, top, -deep), (x + 0.3, floor, deep), paint), plain) for x in (-wide - 0.3, wide)),
        *((Cuboid((-wide, top, z), (wide, floor, z + 0.3), paint), plain) for z in (-deep - 0.3, deep)),
        *((Cuboid((-wide, top - 0.3, z), (wide, top, z + 1.5), paint), plain) for z in (-deep, deep - 1.5)),
    ]
    for idx in range(number + 1):
        middle, half = -wide + idx * pitch, 0.5 * pitch * (1 - share)
        surfaces.append((Cuboid((middle - half, top - 0.4, -deep), (middle + half, top, deep), paint), plain))
    surfaces += [
        (Rod((-wide, top - 0.2, z), (wide, top - 0.2, z), 0.08, STEEL), "strong") for z in np.arange(-deep, deep, 3.5)
    ]
    surfaces += _clutter(rng, floor=floor, low=2, high=min(wide, deep), number=9)
    surfaces += [
        (Quad((wide - 0.01, -1.0, z), (0, 0, 2.0), (0, 1.6, 0), _pick(rng, BLUE, RED, LEAVES)), "strong")
        for z in (-6.0, 0.5, 5.0)
    ]
    return _scene(
        "hall",
        surfaces,
        rng,
        skies=DAY,
        lamp=(1.0, top + 0.6, 1.0),
        spread=(1.8, 0.3, 1.8),
        gain=float(rng.choice([1.0, 1.2])),
    )


def street(rng: np.random.Generator) -> Scene:
    """Return a street between two rows of houses."""
    half, ground = rng.uniform(4, 9), 1.6
    road = _pick(rng, STONE, TILES, PALE)
    surfaces: list[Painted] = [
        (Quad((-40, ground, -60), (80, 0, 0), (0, 0, 120), road), _kind_of_paint(rng, "outdoor", "faint"))
    ]
    for side in (-1, 1):
        z = -50.0
        while z < 50:
            length, height = rng.uniform(6, 14), rng.uniform(4, 14)
            low, high = sorted((side * half, side * (half + 8)))
            paint = _pick(rng, BRICK, STONE, WHITE, PALE)
            surfaces.append(
                (
                    Cuboid((low, ground - height, z), (high, ground, z + length), paint),
                    _kind_of_paint(rng, "outdoor", "outdoor", "faint"),
                )
            )
            z += length + (rng.uniform(0, 3) if rng.random() < 0.4 else 0)
    surfaces += [
        (Rod((-half + 1, ground, z), (-half + 1, ground - 5, z), 0.06, STEEL), "strong")
        for z in (-20.0, -7.0, 6.0, 19.0)
    ]
    surfaces += [(Rod((-half, ground - 4.5, z), (half, ground - 4.5, z), 0.02, STEEL), "none") for z in (-4.0, 11.0)]
    surfaces += _clutter(rng, floor=ground, low=2, high=half, number=7)
    return _scene(
        "street",
        surfaces,
        rng,
        skies=DAY,
        lamp=(20.0, -40.0, 10.0),
        spread=(1.2, 0.2, 1.2),
        gain=float(rng.choice([1.0, 1.3])),
    )


def field(rng: np.random.Generator) -> Scene:
    """Return open ground, at times snow, with single trees and houses far away."""
    ground = 1.6
    snow = rng.random() < 0.4
    surfaces: list[Painted] = [
        (
            Quad((-150, ground, -150), (300, 0, 0), (0, 0, 300), TILES if snow else _pick(rng, LEAVES, STONE)),
            "faint" if snow else "outdoor",
        )
    ]
    for azimuth in rng.uniform(0, 2 * np.pi, 9):
        distance, height = rng.uniform(5, 30), rng.uniform(3, 7)
        x, z = distance * np.sin(azimuth), distance * np.cos(azimuth)
        surfaces.append((Rod((x, ground, z), (x, ground - 0.6 * height, z), 0.04 * height, OAK), "outdoor"))
        surfaces.append((Ball((x, ground - 0.8 * height, z), 0.3 * height, LEAVES), "outdoor"))
    surfaces += _houses(rng, ground=ground, number=5) + _clutter(rng, floor=ground, low=1.5, high=6, number=6)
    return _scene(
        "field",
        surfaces,
        rng,
        skies=DAY,
        lamp=(30.0, -60.0, 10.0),
        spread=(1.0, 0.2, 1.0),
        gain=float(rng.choice([1.0, 1.2])),
    )


def pavilion(rng: np.random.Generator) -> Scene:
    """Return a glass house: a floor with beds and a frame of bars, the sky behind all panes."""
    wide, deep, floor, eaves, ridge = rng.uniform(2.5, 4), rng.uniform(3, 6), 1.5, -1.0, -2.6
    surfaces: list[Painted] = [
        (Quad((-wide, floor, -deep), (2 * wide, 0, 0), (0, 0, 2 * deep), _pick(rng, STONE, OAK)), "strong"),
        (Quad((-90, floor + 0.2, -90), (180, 0, 0), (0, 0, 180), LEAVES), "outdoor"),
        (Rod((0, ridge, -deep), (0, ridge, deep), 0.05, STEEL), "strong"),
    ]
    for side in (-wide, wide):
        surfaces.append(
            (Cuboid((side - 0.05, floor - 0.6, -deep), (side + 0.05, floor, deep), _pick(rng, BRICK, WHITE)), "weak")
        )
        surfaces.append((Rod((side, eaves, -deep), (side, eaves, deep), 0.05, STEEL), "strong"))
        for z in np.arange(-deep, deep + 0.1, 1.0):
            surfaces.append((Rod((side, floor, z), (side, eaves, z), 0.04, STEEL), "strong"))
            surfaces.append((Rod((side, eaves, z), (0, ridge, z), 0.04, STEEL), "strong"))
    surfaces += _clutter(rng, floor=floor, low=1.2, high=min(wide, deep), number=8) + _houses(
        rng, ground=floor, number=7
    )
    return _scene("pavilion", surfaces, rng, skies=DAY, lamp=(6.0, -12.0, 4.0), spread=(0.8, 0.2, 0.8))


def night(rng: np.random.Generator) -> Scene:
    """Return a lit street under a dark sky, or a dark hall without one."""
    if rng.random() < 0.5:
        scene = street(rng)
        return _brighter(_under(replace(scene, room=replace(scene.room, lamp=(0.5, -3.0, 2.0))), rng, NIGHT), 0.6)
    surfaces: list[Painted] = [
        (Cuboid((-6, -3, -5), (6, 1.6, 5), GLOOM), "none"),
        (Quad((-6, 1.599, -5), (12, 0, 0), (0, 0, 10), OAK), "strong"),
        *_clutter(rng, floor=1.6, low=1.5, high=4.5, number=10),
    ]
    return _scene("dark", surfaces, rng, skies=NIGHT, lamp=(1.0, -1.2, 0.8), spread=(1.2, 0.3, 1.2))


def overexposed(rng: np.random.Generator) -> Scene:
    """Return furnished rooms whose pictures are partly clipped."""
    seed, gain = int(rng.integers(1 << 16)), float(rng.choice([1.3, 1.5, 1.8]))
    texture = _kind_of_paint(rng, "weak", "none", "faint", "strong")
    if rng.random() < 0.5:
        room = default_room(seed, texture)
        scene = placed(
            "bright", room, views=4, turned=False, spread=(0.6, 0.3, 0.6), exposure=float(rng.choice([0.0, 0.05]))
        )
    else:
        scene = white_room(seed=seed)
    return _brighter(scene, gain)


def plain(rng: np.random.Generator) -> Scene:
    """Return rooms without windows: plain, white, large, narrow; walls and ceilings at times blue as a sky."""
    seed, exposure = int(rng.integers(1 << 16)), float(rng.choice([0.0, 0.05, 0.12]))
    kind = int(rng.integers(5))
    if kind == 0:
        return placed(
            "plain", default_room(seed, "none"), views=4, turned=True, spread=(0.6, 0.3, 0.6), exposure=exposure
        )
    if kind < 4:
        return (white_room, large_plain_room, corridor)[kind - 1](seed=seed, exposure=exposure)
    surfaces: list[Painted] = [
        (Cuboid((-3.5, -1.6, -3), (3.5, 1.3, 3), ((0.45, 0.62, 0.86),) * 2), "none"),
        (Quad((-3.5, -1.599, -3), (7, 0, 0), (0, 0, 6), ((0.66, 0.78, 0.92),) * 2), "none"),
        (Quad((-3.5, 1.299, -3), (7, 0, 0), (0, 0, 6), OAK), "strong"),
        *_clutter(rng, floor=1.3, low=1.2, high=2.8, number=8),
    ]
    return _scene("blue", surfaces, rng, skies=DAY, lamp=(0.4, -1.2, 0.3), spread=(0.7, 0.3, 0.7))


def attic(rng: np.random.Generator) -> Scene:
    """Return a room of drawn size with plain walls, drawn windows in one wall, and roofs outside or not."""
    return _room_with_openings(rng, "attic", _houses(rng, ground=4.3, number=int(rng.integers(2, 14))))


def openings(rng: np.random.Generator) -> Scene:
    """Return the same room, from which one looks into a large, dark hall with a few lit things."""
    wide, paint = rng.uniform(20, 80), _pick(rng, GLOOM, ((0.30, 0.20, 0.15),) * 2, ((0.25, 0.23, 0.20),) * 2)
    hall: list[Painted] = [(Cuboid((-wide, -0.6 * wide, -wide), (wide, 4.2, wide), paint), "none")]
    for azimuth in rng.uniform(-0.9, 0.9, 5):
        distance, size = rng.uniform(10, 18), rng.uniform(0.5, 2.5)
        x, z = distance * np.sin(azimuth), distance * np.cos(azimuth)
        low, high = (x - size, rng.uniform(-3, 2), z - size), (x + size, 4.2, z + size)
        hall.append((Cuboid(low, high, _pick(rng, BRICK, STONE, WHITE)), "outdoor"))
    return _room_with_openings(rng, "openings", hall)


def _room_with_openings(rng: np.random.Generator, name: str, outside: list[Painted]) -> Scene:
    wide, deep, floor, top = rng.uniform(2.5, 5), rng.uniform(2.5, 5), 1.3, -rng.uniform(1.2, 1.8)
    paint, plain_ = _pick(rng, WHITE, PALE, STONE), _kind_of_paint(rng, "none", "faint", "weak")
    sill, head = floor - rng.uniform(0.5, 1.1), top + rng.uniform(0.2, 0.5)
    edges = np.linspace(-wide, wide, 2 * int(rng.integers(1, 4)) + 2)
    surfaces: list[Painted] = [
        (Cuboid((-wide, top - 0.2, -deep), (wide, top, deep + 0.3), paint), plain_),
        (Cuboid((-wide, top, -deep - 0.2), (wide, floor, -deep), paint), plain_),
        *((Cuboid((x, top, -deep), (x + 0.2, floor, deep + 0.3), paint), plain_) for x in (-wide - 0.2, wide)),
        (Quad((-wide, floor, -deep), (2 * wide, 0, 0), (0, 0, 2 * deep + 0.3), _pick(rng, OAK, STONE)), "strong"),
        (Cuboid((-wide, sill, deep), (wide, floor, deep + 0.25), paint), plain_),
        (Cuboid((-wide, top, deep), (wide, head, deep + 0.25), paint), plain_),
        *(
            (Cuboid((float(a), head, deep), (float(b), sill, deep + 0.25), paint), plain_)
            for a, b in zip(edges[::2], edges[1::2], strict=True)
        ),
        *(
            (
                Rod((float(0.5 * (a + b)), head, deep + 0.1), (float(0.5 * (a + b)), sill, deep + 0.1), 0.03, OAK),
                "strong",
            )
            for a, b in zip(edges[1:-1:2], edges[2::2], strict=True)
        ),
        (Quad((-90, floor + 3, -90), (180, 0, 0), (0, 0, 180), STONE), "outdoor"),
        (Quad((-wide + 0.01, top + 0.5, -0.5), (0, 0, 1.2), (0, 0.9, 0), _pick(rng, BLUE, RED, LEAVES)), "strong"),
        (Quad((-0.6, top + 0.4, -deep + 0.01), (1.3, 0, 0), (0, 0.9, 0), _pick(rng, BLUE, RED, LEAVES)), "strong"),
        *_clutter(rng, floor=floor, low=1.0, high=min(wide, deep), number=6),
        *outside,
    ]
    return _scene(
        name,
        surfaces,
        rng,
        skies=DAY,
        lamp=(0.4, top + 0.4, 0.3),
        spread=(0.7, 0.25, 0.7),
        gain=float(rng.choice([1.0, 1.2])),
    )


KINDS: dict[str, Callable[[np.random.Generator], Scene]] = {
    kind.__name__: kind
    for kind in (
        court,
        trees,
        windows,
        terrace,
        balcony,
        hall,
        street,
        field,
        pavilion,
        night,
        overexposed,
        plain,
        attic,
        openings,
    )
}


def place(kind: str, seed: int) -> Scene:
    """Return a place of a kind."""
    return KINDS[kind](np.random.default_rng([seed, sum(map(ord, kind))]))
