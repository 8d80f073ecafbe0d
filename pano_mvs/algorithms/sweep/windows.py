"""Windows on the sphere: how far a window's columns reach in each row."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import pad_panorama

WIDEST = 8.0
Scalar = TypeVar("Scalar", bound=np.generic)


def column_stretch(height: int, *, spherical: bool) -> NDArray[np.float64]:
    """Return how many columns make the width of one pixel at the equator, (H,): 1/cos of the elevation, at most 8.

    At a pole one column has no width at all; the cap keeps the window from becoming the whole row, which would
    smooth over everything around the pole.
    """
    if not spherical:
        return np.ones(height)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    return np.minimum(1 / np.cos(elevation), WIDEST)


def column_offsets(size_hw: tuple[int, int], radius: int, *, spherical: bool) -> NDArray[np.int64]:
    """Return the columns of a window's pixels against its centre, (H, 2 radius + 1), for a centre in each row.

    A window never reaches further than a quarter of the way around.
    """
    height, width = size_hw
    stretch = column_stretch(height, spherical=spherical)
    offsets = np.rint(np.arange(-radius, radius + 1) * stretch[:, None]).astype(np.int64)
    return np.clip(offsets, -(width // 4), width // 4)


def neighbours(picture: NDArray[Scalar], rows: int, columns: NDArray[np.int64]) -> NDArray[Scalar]:
    """Return for every pixel the one that lies `rows` below and `columns` (H,) to its right, (H, W)."""
    height, width = picture.shape
    pad = abs(rows)
    shifted = pad_panorama(picture, pad)[pad + rows : pad + rows + height, pad : pad + width]
    return np.take_along_axis(shifted, (np.arange(width) + columns[:, None]) % width, axis=1)
