"""Compiled: how much of the surface around a pixel other views confirm."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pano_mvs.algorithms.filters.kernels_reprojection import wrapped_column, wrapped_row


@njit(cache=True, error_model="numpy", nogil=True)
def support_share(ranges, confirmed, stretches, radius, max_step, row, column):  # type: ignore[no-untyped-def]
    """Return the share of a window, by number of pixels, that is confirmed and of the surface of the pixel."""
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


@njit(cache=True, error_model="numpy", nogil=True)
def find_supported(ranges, confirmed, stretches, radius, max_step, least):  # type: ignore[no-untyped-def]
    """Return the pixels, (H, W) bool, that are not confirmed while at least a share `least` of their window is."""
    height, width = ranges.shape
    supported = np.zeros((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            if math.isfinite(ranges[row, column]) and not confirmed[row, column]:
                share = support_share(ranges, confirmed, stretches, radius, max_step, row, column)
                supported[row, column] = share >= least
    return supported
