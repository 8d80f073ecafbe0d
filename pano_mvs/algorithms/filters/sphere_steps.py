"""Steps on the pixel grid that are as wide on the sphere as they are high."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def columns_per_step(size_hw: tuple[int, int], *, steps: int) -> NDArray[np.int64]:
    """Return for each row how many columns are as wide as a pixel at the equator: 1 / cos φ, rounded, (H,) int64.

    Limited so that a window of `steps` steps goes no more than once around.
    """
    height, width = size_hw
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    columns: NDArray[np.int64] = np.rint(1 / np.cos(elevation)).astype(np.int64)
    return np.clip(columns, 1, max(1, width // steps))
