"""Compiled: the share of the surface around a pixel that other views confirm."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import wrapped_column, wrapped_row


@kernel
def support_share(
    ranges: NDArray[np.float32],
    confirmed: NDArray[np.bool_],
    stretches: NDArray[np.int64],
    radius: int,
    max_step: float,
    row: int,
    column: int,
) -> float:
    """Return the share of a window's pixels that are confirmed and on the surface of the pixel."""
    height, width = ranges.shape
    center = ranges[row, column]
    count = 0
    for d_row in range(-radius, radius + 1):
        for d_column in range(-radius, radius + 1):
            other_row = wrapped_row(row + d_row, height)
            other_column = wrapped_column(row + d_row, column + d_column * stretches[row], height, width)
            if confirmed[other_row, other_column]:
                steps = max(max(abs(d_row), abs(d_column)), 1)
                if abs(center / ranges[other_row, other_column] - 1) < max_step * steps:
                    count += 1
    return count / (2 * radius + 1) ** 2


@kernel
def find_supported(
    ranges: NDArray[np.float32],
    confirmed: NDArray[np.bool_],
    stretches: NDArray[np.int64],
    radius: int,
    max_step: float,
    least: float,
) -> NDArray[np.bool_]:
    """Return the pixels, (H, W) bool, that are not confirmed although at least a share `least` of their window is."""
    height, width = ranges.shape
    supported = np.zeros((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            if math.isfinite(ranges[row, column]) and not confirmed[row, column]:
                share = support_share(ranges, confirmed, stretches, radius, max_step, row, column)
                supported[row, column] = share >= least
    return supported
