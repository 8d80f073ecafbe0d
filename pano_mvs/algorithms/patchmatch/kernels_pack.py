"""Compiled: pack pictures so that one number holds the four grey levels around a position."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import wrapped_column, wrapped_row

# Parts of red, green and blue in 10,000; levels are in 1/256.
_RED, _GREEN, _BLUE, _WHOLE, _FINE = 2126, 7152, 722, 10000, 256


@kernel
def pack_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return all 2×2 patches of the grey levels of a picture, (H, W, 3) to (H + 1, W + 1), over the seam and the poles.

    Patch (j, i) is upper left | lower left << 16 | upper right << 32 | lower right << 48 of rows j − 1, j and columns
    i − 1, i, in 1/256 grey levels, rounded.
    """
    height, width, _ = picture.shape
    grey = np.empty((height, width), np.uint64)
    for row in range(height):
        for column in range(np.uint64(width)):
            red, green, blue = picture[row, column, 0], picture[row, column, 1], picture[row, column, 2]
            level = np.int32(_RED) * red + np.int32(_GREEN) * green + np.int32(_BLUE) * blue
            grey[row, column] = (np.uint32(level) * np.uint32(_FINE) + np.uint32(_WHOLE // 2)) // np.uint32(_WHOLE)
    packed = np.empty((height + 1, width + 1), np.uint64)
    for j in range(height + 1):
        upper, lower = wrapped_row(j - 1, height), wrapped_row(j, height)
        for i in range(width + 1):
            upper_left, upper_right = (
                wrapped_column(j - 1, i - 1, height, width),
                wrapped_column(j - 1, i, height, width),
            )
            lower_left, lower_right = wrapped_column(j, i - 1, height, width), wrapped_column(j, i, height, width)
            left = grey[upper, upper_left] | grey[lower, lower_left] << np.uint64(16)
            right = grey[upper, upper_right] | grey[lower, lower_right] << np.uint64(16)
            packed[j, i] = left | right << np.uint64(32)
    return packed
