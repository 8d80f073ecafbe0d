"""Panoramas as square tiles in levels of growing resolution."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

TILE = 1024
"""Width of a tile in pixels: level 0 is one tile of 1024 x 512, level L is 2^L columns by 2^(L-1) rows."""


def level_count(width: int, max_width: int) -> int:
    """Return how many levels a panorama has: the last one is not wider than the panorama, unless it is the only one."""
    return max(0, int(np.log2(min(width, max_width) / TILE))) + 1


def panorama_tiles(image: NDArray[np.uint8], levels: int) -> Iterator[tuple[int, int, int, NDArray[np.uint8]]]:
    """Yield (level, column, row, pixels) of all tiles.

    Args:
        image: (H, W, 3) uint8, a panorama.
        levels: number of levels.
    """
    for level in range(levels):
        width = TILE << level
        shrinks = width < image.shape[1]
        scaled = cv2.resize(image, (width, width // 2), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        height = min(TILE, width // 2)
        for row in range(width // 2 // height):
            for column in range(1 << level):
                tile = scaled[row * height : (row + 1) * height, column * TILE : (column + 1) * TILE]
                yield level, column, row, np.asarray(tile, np.uint8)
