"""Colours of the surfaces of the synthetic scenes, and of the sky."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.testing.surfaces import Vector
from pano_mvs.testing.texture import noise

Texture = Literal["strong", "weak", "faint", "isotropic", "outdoor", "none"]

Colors = tuple[Vector, Vector]


class Pattern(Protocol):
    """A texture with its own colours."""

    def albedo(self, points: FloatArray, normals: FloatArray, *, footprint: FloatArray) -> FloatArray:
        """Return the unlit colours (N, 3) of points (N, 3) with normals (N, 3), for pixels of width `footprint`."""


WHITE: Colors = ((0.86, 0.86, 0.84), (0.86, 0.86, 0.84))
OAK: Colors = ((0.62, 0.44, 0.27), (0.42, 0.28, 0.17))
BRICK: Colors = ((0.62, 0.36, 0.27), (0.50, 0.40, 0.33))
STONE: Colors = ((0.62, 0.60, 0.54), (0.47, 0.46, 0.44))
LEAVES: Colors = ((0.22, 0.42, 0.16), (0.40, 0.50, 0.22))
STEEL: Colors = ((0.36, 0.40, 0.46), (0.60, 0.60, 0.62))
BLUE: Colors = ((0.25, 0.38, 0.62), (0.45, 0.60, 0.75))
RED: Colors = ((0.70, 0.26, 0.22), (0.80, 0.52, 0.40))

# Cell sizes in scene units, with the amplitude of the noise on each.
_LIGHTNESS: dict[Texture, tuple[tuple[float, float], ...]] = {
    "strong": ((0.018, 0.4), (0.055, 0.5), (0.19, 0.5)),
    "weak": ((0.047, 0.03), (0.16, 0.05)),
    "faint": ((0.047, 0.01), (0.16, 0.018)),
    "isotropic": ((0.015, 0.7), (0.047, 0.7)),
    "outdoor": ((0.012, 0.25), (0.04, 0.25), (0.13, 0.3), (0.5, 0.3)),
    "none": (),
}
_HUE: dict[Texture, tuple[tuple[float, float], ...]] = {
    "strong": ((0.06, 1.0),),
    "weak": ((0.2, 0.15),),
    "faint": ((0.2, 0.05),),
    "isotropic": ((0.06, 0.6),),
    "outdoor": ((0.25, 0.8),),
    "none": (),
}
_CLOUDS = ((0.06, 0.8),)
# Mean wavelength of the noise in cells.
_WAVELENGTH = 7.0


def albedo_at(
    points: FloatArray, colors_rgb: Colors, texture: Texture, *, seed: int, footprint: FloatArray
) -> FloatArray:
    """Return the unlit colours (N, 3) of points (N, 3) of a surface.

    Args:
        points: in world coordinates; a point has the same colour from every viewpoint.
        colors_rgb: the two colours between which the hue varies.
        texture: kind of texture.
        seed: seed of the texture.
        footprint: (N,) width of a pixel at each point. The texture "outdoor" fades where a pixel averages over its
            waves, since a far wall would otherwise flicker between views; the others do not depend on it.
    """
    share = 0.5 + 0.5 * np.tanh(_octaves(points, _HUE[texture], texture, seed=seed, footprint=footprint))
    lightness = _octaves(points, _LIGHTNESS[texture], texture, seed=seed + 1, footprint=footprint)
    first, second = np.array(colors_rgb)
    albedo: FloatArray = share[:, None] * first + (1 - share[:, None]) * second
    return albedo * (1 + 0.65 * np.tanh(lightness)[:, None])


def _octaves(
    points: FloatArray, cells: tuple[tuple[float, float], ...], texture: Texture, *, seed: int, footprint: FloatArray
) -> FloatArray:
    """Return the sum of the noise (N,) of all cell sizes, fading for the texture "outdoor"."""
    if texture != "outdoor":
        return noise(points, cells=cells, seed=seed)
    total = np.zeros(len(points))
    for octave, (size, strength) in enumerate(cells):
        left = np.exp(-((2 * footprint / (_WAVELENGTH * size)) ** 2))
        total += left * noise(points, cells=((size, strength),), seed=seed + 7919 * octave)
    return total


def sky_color(rays_in_world: FloatArray, sky: tuple[Vector, Vector], *, seed: int, clouds: float = 0.35) -> FloatArray:
    """Return the colours (N, 3) of the sky along unit rays (N, 3); clouds are infinitely far away, and 1 is thick."""
    zenith, horizon = np.array(sky)
    height = np.clip(-rays_in_world[:, 1], 0, 1)[:, None] ** 0.5
    clear: FloatArray = height * zenith + (1 - height) * horizon
    if not clouds:
        return clear
    cloud = 0.5 + 0.5 * np.tanh(noise(rays_in_world, cells=_CLOUDS, seed=seed + 0x5C))[:, None]
    mixed: FloatArray = clear + clouds * cloud * (1 - clear)
    return mixed
