"""Small images printed on the surfaces of the repeating places: tiles, house fronts, columns, posters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.testing.room import Colors

Image: TypeAlias = NDArray[np.float32]
Kind: TypeAlias = Literal[
    "bay",
    "cabinet",
    "ceiling",
    "checker",
    "column",
    "door",
    "gravel",
    "marble",
    "motif",
    "plain",
    "poster",
    "tread",
    "wall",
    "wear",
]

_DARK = 0.55


@dataclass(frozen=True)
class Drawing:
    """The content of an image; equal drawings give equal images.

    Attributes:
        kind: kind of the drawing.
        colors_rgb: its two main colours in [0, 1].
        seed: seed of its random parts.
        texels: its width and height, a power of two.
    """

    kind: Kind
    colors_rgb: Colors
    seed: int = 0
    texels: int = 256


@lru_cache(maxsize=128)
def pyramid(drawing: Drawing) -> tuple[Image, ...]:
    """Return the image (n, n, 3) float32 in [0, 1] of a drawing, then successively halved down to one texel."""
    rng = np.random.default_rng([drawing.seed, sum(map(ord, drawing.kind))])
    level = np.clip(_PAINTERS[drawing.kind](rng, drawing.texels, drawing.colors_rgb), 0, 1).astype(np.float32)
    levels = [level]
    while len(level) > 1:
        level = (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2]) / np.float32(4)
        levels.append(level)
    return tuple(levels)


def _plain(_rng: np.random.Generator, size: int, colors: Colors) -> Image:
    return _filled(size, colors[0])


def _wear(rng: np.random.Generator, size: int, _colors: Colors) -> Image:
    """Return noise with mean ½ and standard deviation ⅙, with wavelengths from 5 texels to a quarter of the size."""
    noise = _clouds(rng, size, (5, 40)) + _clouds(rng, size, (40, size / 4))
    return np.repeat((0.5 + noise / np.sqrt(2) / 6)[..., None], 3, axis=2).astype(np.float32)


def _marble(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return one tile of veined stone with half of the joint on each side."""
    return _jointed(_stone(rng, size, colors))


def _checker(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return two by two tiles, light and dark."""
    half = size // 2
    light, dark = (
        _stone(rng, half, (colors[0], _mixed(colors, 0.75))),
        _stone(rng, half, (colors[1], _mixed(colors, 0))),
    )
    light, dark = _jointed(light), _jointed(dark * _DARK)
    return np.concatenate([np.concatenate([light, dark], axis=1), np.concatenate([dark, light], axis=1)])


def _motif(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return one cement tile with an ornament with the tile's symmetries."""
    x, y = _grid(size)
    radius, turn = np.hypot(x, y), np.arctan2(y, x)
    petals = radius < 0.30 + 0.10 * np.cos(4 * turn * rng.integers(1, 3))
    ring = np.abs(radius - rng.uniform(0.40, 0.46)) < 0.02
    corner = np.abs(x) + np.abs(y) > rng.uniform(0.76, 0.86)
    image = _filled(size, colors[0])
    image[petals | ring] = np.array(colors[1])
    image[corner] = np.array(_mixed(colors, 0.5)) * _DARK
    image[radius < rng.uniform(0.08, 0.14)] = np.array(colors[0]) * _DARK
    return _jointed(_shaded(image, 0.05 * _clouds(rng, size, (6, 60))))


def _gravel(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    noise = 0.16 * _clouds(rng, size, (5, 14)) + 0.05 * _clouds(rng, size, (14, 90))
    return _shaded(_blend(colors, 0.5 + 0.5 * np.tanh(_clouds(rng, size, (8, 40)))), noise)


def _column(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return the mantle of a column: 20 flutes around it, drums with joints, and bands at both ends."""
    x, y = _grid(size)
    flutes = 0.16 * np.cos(2 * np.pi * 20 * x)
    drums = np.abs((3 * (y + 0.5)) % 1 - 0.5) > 0.492
    bands = np.abs(np.abs(y) - 0.47) < 0.012
    image = _stone(rng, size, colors)
    return _shaded(image, np.where(np.abs(y) < 0.45, flutes, 0.0) - 0.25 * drums - 0.35 * bands)


def _wall(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return a panel of plaster with faint shading, a seam at its sides, and a dark skirting board."""
    x, y = _grid(size)
    image = _shaded(_filled(size, colors[0]), 0.012 * _clouds(rng, size, (8, 80)))
    image[np.abs(x) > 0.497] *= np.float32(0.9)
    image[y > 0.46] = np.array(colors[1]) * _DARK
    return image


def _ceiling(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return a panel of a suspended ceiling with a lamp."""
    x, y = _grid(size)
    image = _shaded(_filled(size, colors[0]), 0.01 * _clouds(rng, size, (4, 10)))
    lamp = (np.abs(x) < 0.32) & (np.abs(y) < 0.10)
    image[(np.abs(x) < 0.34) & (np.abs(y) < 0.12)] *= np.float32(0.7)
    image[lamp] = 1.0
    image[(np.abs(x) > 0.494) | (np.abs(y) > 0.494) | (np.abs(y) < 0.004)] *= np.float32(0.72)
    return image


def _bay(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return one bay of a house front: brick or plaster, a window with bars, a sill, a cornice."""
    x, y = _grid(size)
    image = _bricks(rng, size, colors) if rng.random() < 0.5 else _gravel(rng, size, (colors[0], _mixed(colors, 0.8)))
    width, head, foot = rng.uniform(0.18, 0.26), rng.uniform(-0.34, -0.28), rng.uniform(0.12, 0.22)
    image[(np.abs(x) < width + 0.04) & (y > head - 0.05) & (y < foot + 0.01)] = (0.80, 0.78, 0.72)
    pane = (np.abs(x) < width) & (y > head) & (y < foot)
    glass = _blend(((0.20, 0.26, 0.32), (0.42, 0.50, 0.58)), 0.5 + (y - x) + 0.1 * _clouds(rng, size, (20, 120)))
    image[pane] = glass[pane]
    across = np.abs((x / width + 1) * rng.integers(1, 3) % 1 - 0.5) > 0.46
    image[pane & (across | (np.abs(y - 0.7 * head) < 0.008))] = (0.88, 0.87, 0.84)
    image[(np.abs(x) < width + 0.07) & (np.abs(y - foot - 0.025) < 0.02)] = (0.60, 0.58, 0.53)
    image[y < -0.46] *= np.float32(0.75)
    return image


def _door(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return one bay of a corridor: a plain wall with a panelled door, a handle and a plate."""
    x, y = _grid(size)
    image = _wall(rng, size, ((0.84, 0.83, 0.79), colors[1]))
    width, head = rng.uniform(0.15, 0.19), rng.uniform(-0.28, -0.22)
    image[(np.abs(x) < width + 0.02) & (y > head - 0.02)] = (0.72, 0.71, 0.68)
    leaf = (np.abs(x) < width) & (y > head)
    grain = 0.10 * _clouds(rng, size, (4, 40))[:, :1] + 0.05 * _clouds(rng, size, (5, 60))
    wood = _shaded(_filled(size, colors[0]), grain)
    image[leaf] = wood[leaf]
    for top, bottom in ((head + 0.04, 0.05), (0.12, 0.44)):
        box = (np.abs(x) < width - 0.04) & (y > top) & (y < bottom)
        inner = (np.abs(x) < width - 0.05) & (y > top + 0.01) & (y < bottom - 0.01)
        image[box & ~inner] *= np.float32(0.6)
    image[(np.abs(x - width + 0.02) < 0.012) & (np.abs(y - 0.09) < 0.008)] = (0.85, 0.80, 0.55)
    image[(np.abs(x + width + 0.06) < 0.025) & (np.abs(y + 0.05) < 0.02)] = np.array(colors[1]) * _DARK
    return image


def _tread(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return the stone of a stair with a dark strip along one edge."""
    _, y = _grid(size)
    image = _stone(rng, size, colors)
    image[np.abs(y - 0.42) < 0.05] *= np.float32(0.4)
    return image


def _cabinet(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return wood with drawers and knobs, or striped cloth."""
    x, y = _grid(size)
    rows = int(rng.integers(2, 6))
    image = _shaded(
        _blend(colors, 0.5 + 0.5 * np.tanh(_clouds(rng, size, (6, 90)))), 0.12 * _clouds(rng, size, (4, 30))
    )
    across = (rows * (y + 0.5)) % 1
    image[(across < 0.05) | (np.abs(x) > 0.48)] *= np.float32(0.5)
    image[(np.abs(across - 0.5) < 0.1) & (np.abs(np.abs(x) - 0.2) < 0.03)] = rng.uniform(0.1, 0.9, 3)
    return image


def _poster(rng: np.random.Generator, size: int, _colors: Colors) -> Image:
    """Return a unique framed image: coloured shapes on a wash, and lines that resemble writing."""
    x, y = _grid(size)
    wash = 0.5 + 0.35 * _clouds(rng, size, (20, 150))
    image = _blend((tuple(rng.uniform(0.2, 0.95, 3)), tuple(rng.uniform(0.2, 0.95, 3))), wash)
    for _ in range(rng.integers(6, 14)):
        (at_x, at_y), (wide, high) = rng.uniform(-0.4, 0.4, 2), rng.uniform(0.03, 0.2, 2)
        turn = rng.uniform(0, np.pi)
        u = np.cos(turn) * (x - at_x) + np.sin(turn) * (y - at_y)
        v = np.cos(turn) * (y - at_y) - np.sin(turn) * (x - at_x)
        box, oval = (np.abs(u) < wide) & (np.abs(v) < high), (u / wide) ** 2 + (v / high) ** 2 < 1
        image[box if rng.random() < 0.5 else oval] = rng.uniform(0.02, 0.98, 3)
    words = np.kron(rng.random((5, 30)) < 0.7, [[1, 1, 1], [0, 0, 0]]).astype(bool)
    top = int(rng.uniform(0.1, 0.8) * size)
    block = image[top : top + len(words), size // 8 : size // 8 + words.shape[1]]
    block[words[: len(block), : block.shape[1]]] = rng.uniform(0, 1)
    image[(np.abs(x) > 0.47) | (np.abs(y) > 0.47)] = rng.uniform(0.05, 0.5)
    return image


_PAINTERS: dict[Kind, Callable[[np.random.Generator, int, Colors], Image]] = {
    "bay": _bay,
    "cabinet": _cabinet,
    "ceiling": _ceiling,
    "checker": _checker,
    "column": _column,
    "door": _door,
    "gravel": _gravel,
    "marble": _marble,
    "motif": _motif,
    "plain": _plain,
    "poster": _poster,
    "tread": _tread,
    "wall": _wall,
    "wear": _wear,
}


def _stone(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return veined stone that does not continue periodically beyond its edges."""
    bend = _clouds(rng, 2 * size, (20, 120))[:size, :size]
    field = _clouds(rng, 2 * size, (40, 260))[:size, :size] + 0.25 * bend
    veins = np.exp(-((field / 0.07) ** 2)) * np.clip(0.6 + 0.5 * bend, 0, 1)
    grain = _clouds(rng, 2 * size, (5, 16))[:size, :size]
    image = _blend(colors, 0.5 + 0.35 * np.tanh(0.8 * field))
    return _shaded(image, 0.045 * grain + 0.05 * bend - 0.28 * veins)


def _bricks(rng: np.random.Generator, size: int, colors: Colors) -> Image:
    """Return 16 courses of 6 bricks, every second course shifted by half a brick."""
    x, y = _grid(size)
    course = np.floor((y + 0.5) * 16).astype(int)
    along = (x + 0.5) * 6 + 0.5 * (course % 2)
    number = np.floor(along).astype(int) % 6
    shade = rng.normal(0, 0.12, (16, 6))[course, number]
    joint = (along % 1 < 0.05) | ((y + 0.5) * 16 % 1 < 0.14)
    image = _shaded(_filled(size, colors[0]), shade + 0.06 * _clouds(rng, size, (4, 12)))
    image[joint] = (0.66, 0.63, 0.58)
    return image


def _jointed(image: Image) -> Image:
    """Return a tile with half of the surrounding joints, and the slightly darker edge of cut stone."""
    x, y = _grid(len(image))
    edge = np.maximum(np.abs(x), np.abs(y))
    image = _shaded(image, np.where(edge > 0.485, -0.12, 0.0))
    image[edge > 0.4935] = (0.33, 0.32, 0.30)
    return image


def _clouds(rng: np.random.Generator, size: int, wavelengths_px: tuple[float, float]) -> NDArray[np.float64]:
    """Return periodic noise (n, n) of unit variance with wavelengths between two limits."""
    frequency = np.fft.fftfreq(size)
    radius = np.hypot(frequency[:, None], frequency)
    band = (radius >= 1 / wavelengths_px[1]) & (radius <= 1 / wavelengths_px[0])
    weight = np.where(band, 1 / np.maximum(radius, 1 / size), 0)  # equal power in each octave
    noise = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) * weight).real
    return np.asarray(noise / noise.std())


def _grid(size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x and y (n, n) of the texels' centres, from −½ to ½; y is down."""
    at = (np.arange(size) + 0.5) / size - 0.5
    return np.broadcast_to(at, (size, size)), np.broadcast_to(at[:, None], (size, size))


def _filled(size: int, color: tuple[float, float, float]) -> Image:
    return np.full((size, size, 3), color, np.float32)


def _blend(colors: Colors, share: NDArray[np.float64]) -> Image:
    part = np.clip(share, 0, 1)[..., None]
    return np.asarray(part * np.array(colors[0]) + (1 - part) * np.array(colors[1]), np.float32)


def _shaded(image: Image, lightness: NDArray[np.float64]) -> Image:
    return (image * (1 + lightness[..., None])).astype(np.float32)


def _mixed(colors: Colors, share: float) -> tuple[float, float, float]:
    red, green, blue = share * np.array(colors[0]) + (1 - share) * np.array(colors[1])
    return float(red), float(green), float(blue)
