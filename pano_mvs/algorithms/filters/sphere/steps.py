"""Step widths on the pixel grid that are isotropic on the sphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def columns_per_step(size_hw: tuple[int, int], *, steps: int) -> NDArray[np.int64]:
    """Return for each row the number of columns as wide as a pixel at the equator: 1 / cos φ, rounded, (H,) int64.

    Limited so that a window of `steps` steps covers at most the full circle.
    """
    height, width = size_hw
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    columns: NDArray[np.int64] = np.rint(1 / np.cos(elevation)).astype(np.int64)
    return np.clip(columns, 1, max(1, width // steps))
