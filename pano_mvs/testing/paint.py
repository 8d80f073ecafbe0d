"""Colours of the surfaces of the synthetic scenes, and of the sky."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, Protocol

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import rotation_from_quat_wxyz
from pano_mvs.testing.surfaces import Vector

Texture = Literal["strong", "weak", "faint", "isotropic", "outdoor", "none"]

Colors = tuple[Vector, Vector]


class Pattern(Protocol):
    """A texture with its own colours."""

    def albedo(self, points: FloatArray, normals: FloatArray, *, footprint: FloatArray) -> FloatArray:
        """Return the unlit colours (N, 3) of points (N, 3) with normals (N, 3), for pixels of width `footprint`."""


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


def albedo_at(
    points: FloatArray, colors_rgb: Colors, texture: Texture, *, seed: int, footprint: FloatArray
) -> FloatArray:
    """Return the unlit colours (N, 3) of points (N, 3) of a surface.

    Args:
        points: in world coordinates; a point has the same colour from every viewpoint.
        colors_rgb: the two colours between which the hue varies.
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
        # Mean wavelength of the noise in cells.
        left = np.exp(-((2 * footprint / (7.0 * size)) ** 2))
        total += left * noise(points, cells=((size, strength),), seed=seed + 7919 * octave)
    return total


def sky_color(rays_in_world: FloatArray, sky: tuple[Vector, Vector], *, seed: int, clouds: float = 0.35) -> FloatArray:
    """Return the colours (N, 3) of the sky along unit rays (N, 3); clouds are infinitely far away, and 1 is thick."""
    zenith, horizon = np.array(sky)
    height = np.clip(-rays_in_world[:, 1], 0, 1)[:, None] ** 0.5
    clear: FloatArray = height * zenith + (1 - height) * horizon
    if not clouds:
        return clear
    cloud = 0.5 + 0.5 * np.tanh(noise(rays_in_world, cells=((0.06, 0.8),), seed=seed + 0x5C))[:, None]
    mixed: FloatArray = clear + clouds * cloud * (1 - clear)
    return mixed


_CELLS = 64


def noise(points: FloatArray, *, cells: Sequence[tuple[float, float]], seed: int) -> FloatArray:
    """Return smooth noise, about normally distributed, at points.

    Args:
        points: (N, 3).
        cells: pairs of cell size in scene units and standard deviation of the noise on that lattice; its wavelengths
            are 4 to 12 cells.
        seed: each seed gives an independent texture.

    Returns:
        (N,) values with mean near 0.
    """
    rng = np.random.default_rng(seed)
    total = np.zeros(len(points))
    for size, strength in cells:
        turn = rotation_from_quat_wxyz(rng.normal(size=4))  # so that no lattice is parallel to a wall
        offset = rng.uniform(0, _CELLS, 3)
        total += strength * _interpolated(points @ (turn / size) + offset)
    return total


def _interpolated(positions: FloatArray) -> FloatArray:
    """Return the periodic volume at positions (N, 3) in cells, by trilinear interpolation."""
    volume = _volume().ravel()
    low = np.floor(positions)
    after = positions - low
    before, index = 1 - after, low.astype(np.int64)
    x, y, z = (
        (((index[:, k] % _CELLS) * step, before[:, k]), (((index[:, k] + 1) % _CELLS) * step, after[:, k]))
        for k, step in enumerate((_CELLS * _CELLS, _CELLS, 1))
    )
    result = np.zeros(len(positions))
    for index_x, share_x in x:
        for index_y, share_y in y:
            row, share = index_x + index_y, share_x * share_y
            for index_z, share_z in z:
                result += share * share_z * volume[row + index_z]
    return result


@lru_cache(maxsize=1)
def _volume() -> FloatArray:
    """Return periodic, isotropic, band-limited noise of unit variance, (64, 64, 64)."""
    white = np.random.default_rng(0x3D).normal(size=(_CELLS,) * 3)
    frequency = np.fft.fftfreq(_CELLS)
    radius = np.sqrt(np.sum(np.stack(np.meshgrid(frequency, frequency, frequency)) ** 2, axis=0))
    # Wavelengths of the noise in cells: trilinear interpolation needs about four cells to be smooth.
    band = (radius >= 1 / 12) & (radius <= 1 / 4)
    filtered = np.fft.ifftn(np.fft.fftn(white) * band).real
    return np.asarray(filtered / filtered.std())
