"""Band-limited noise in 3D: a point of a surface has the same colour from every viewpoint."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import rotation_from_quat_wxyz

_CELLS = 64
# Wavelengths of the noise in cells: trilinear interpolation needs about four cells to be smooth.
_SHORTEST, _LONGEST = 4.0, 12.0


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
    weight = positions - low
    index = low.astype(np.int64)
    columns = [
        ((index[:, k] % _CELLS) * step, ((index[:, k] + 1) % _CELLS) * step)
        for k, step in enumerate((_CELLS * _CELLS, _CELLS, 1))
    ]
    result = np.zeros(len(positions))
    for corner in np.ndindex(2, 2, 2):
        share = np.ones(len(positions))
        for k in range(3):
            share *= weight[:, k] if corner[k] else 1 - weight[:, k]
        result += share * volume[columns[0][corner[0]] + columns[1][corner[1]] + columns[2][corner[2]]]
    return result


@lru_cache(maxsize=1)
def _volume() -> FloatArray:
    """Return periodic, isotropic, band-limited noise of unit variance, (64, 64, 64)."""
    white = np.random.default_rng(0x3D).normal(size=(_CELLS,) * 3)
    frequency = np.fft.fftfreq(_CELLS)
    radius = np.sqrt(np.sum(np.stack(np.meshgrid(frequency, frequency, frequency)) ** 2, axis=0))
    band = (radius >= 1 / _LONGEST) & (radius <= 1 / _SHORTEST)
    filtered = np.fft.ifftn(np.fft.fftn(white) * band).real
    return np.asarray(filtered / filtered.std())
