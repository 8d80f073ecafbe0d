"""Compiled: fill holes from the nearest trusted ranges around them."""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import wrapped_column, wrapped_row

FloatArray = NDArray[np.float64]

_DIRECTIONS = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))


@kernel
def nearest_trusted(
    inverse: FloatArray,
    trusted: NDArray[np.bool_],
    stretches: NDArray[np.int64],
    row: int,
    column: int,
    d_row: int,
    d_column: int,
    max_steps: int,
) -> tuple[float, float]:
    """Return (1/range, steps) of the first trusted pixel in a direction; steps is 0 if there is none."""
    height, width = inverse.shape
    # prange counts in unsigned integers, and unsigned plus signed would be a float.
    y, x = np.int64(row), np.int64(column)
    for step in range(1, max_steps + 1):
        x += d_column * stretches[wrapped_row(y, height)]
        y += d_row
        in_row, in_column = wrapped_row(y, height), wrapped_column(y, x, height, width)
        if trusted[in_row, in_column]:
            # A diagonal step is longer.
            return inverse[in_row, in_column], step * math.sqrt(float(d_row * d_row + d_column * d_column))
    return 0.0, 0.0


@kernel
def background_mean(values: FloatArray, steps: FloatArray, count: int, max_ratio: float) -> tuple[float, float]:
    """Return the mean of the farther of some 1/ranges, weighted by 1/steps, and the steps to the nearest of them.

    Values up to `max_ratio` times the second smallest count as far.
    """
    smallest, second = np.inf, np.inf
    for idx in range(count):
        if values[idx] < smallest:
            smallest, second = values[idx], smallest
        elif values[idx] < second:
            second = values[idx]
    total, weight, nearest = 0.0, 0.0, np.inf
    for idx in range(count):
        if values[idx] <= max_ratio * second:
            total += values[idx] / steps[idx]
            weight += 1 / steps[idx]
            nearest = min(nearest, steps[idx])
    return total / weight, nearest


@kernel(parallel=True)
def fill_holes(
    inverse: FloatArray,
    wanted: NDArray[np.bool_],
    trusted: NDArray[np.bool_],
    stretches: NDArray[np.int64],
    max_steps: int,
    max_ratio: float,
) -> tuple[FloatArray, FloatArray]:
    """Return, for each wanted pixel, 1/range and the steps to the nearest background pixel (0: not filled)."""
    height, width = inverse.shape
    filled, distances = np.zeros((height, width)), np.zeros((height, width))
    for row in prange(height):
        values, steps = np.empty(8), np.empty(8)
        for column in range(width):
            if wanted[row, column]:
                count = 0
                for d_row, d_column in _DIRECTIONS:
                    value, distance = nearest_trusted(
                        inverse, trusted, stretches, row, column, d_row, d_column, max_steps
                    )
                    if distance > 0:
                        values[count], steps[count] = value, distance
                        count += 1
                # One neighbour alone may be the occluder.
                if count >= 2:
                    filled[row, column], distances[row, column] = background_mean(values, steps, count, max_ratio)
    return filled, distances
