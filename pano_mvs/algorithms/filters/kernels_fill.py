"""Compiled: connected surfaces of a range map on the sphere, and holes filled from the nearest trusted ranges."""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import inlined, kernel
from pano_mvs.geometry.kernels_sphere import wrapped_column, wrapped_row


@kernel
def _root(parents: NDArray[np.int64], index: int) -> int:
    while parents[index] != index:
        parents[index] = parents[parents[index]]
        index = parents[index]
    return index


@inlined
def _join(parents: NDArray[np.int64], first: int, second: int) -> None:
    a, b = _root(parents, first), _root(parents, second)
    # The smaller index wins, so that a component's label is its first pixel.
    if a < b:
        parents[b] = a
    else:
        parents[a] = b


@kernel
def label_surfaces(ranges: NDArray[np.float32], max_step: float) -> NDArray[np.int64]:
    """Return for each pixel the flat index of the first pixel of its component, (H W) int64; −1 is invalid.

    Neighbours in a row or a column (over the seam, over the poles) are connected if neither range exceeds the other
    by more than the relative step.
    """
    height, width = ranges.shape
    flat = ranges.ravel()
    parents = np.arange(height * width)
    for row in range(height):
        for column in range(width):
            here = row * width + column
            right = row * width + (column + 1) % width
            below = here + width
            if row == height - 1:
                below = row * width + wrapped_column(height, column, height, width)
            for other in (right, below):
                a, b = flat[here], flat[other]
                if math.isfinite(a) and math.isfinite(b) and max(a, b) <= min(a, b) * (1 + max_step):
                    _join(parents, here, other)
            if row == 0:
                other = wrapped_column(-1, column, height, width)
                a, b = flat[here], flat[other]
                if math.isfinite(a) and math.isfinite(b) and max(a, b) <= min(a, b) * (1 + max_step):
                    _join(parents, here, other)
    labels = np.empty(height * width, np.int64)
    for index in range(height * width):
        labels[index] = _root(parents, index) if math.isfinite(flat[index]) else -1
    return labels


_DIRECTIONS = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))


@kernel(parallel=True)
def fill_holes(
    inverse: FloatArray,
    wanted: NDArray[np.bool_],
    trusted: NDArray[np.bool_],
    stretches: NDArray[np.int64],
    max_steps: int,
    max_ratio: float,
) -> tuple[FloatArray, FloatArray]:
    """Return, for each wanted pixel, 1/range and the steps to the nearest background pixel (0: not filled).

    In each of eight directions the first trusted pixel counts. 1/range is the mean of the farther of them, weighted by
    1/steps; values up to `max_ratio` times the second smallest count as far.
    """
    height, width = inverse.shape
    filled, distances = np.zeros((height, width)), np.zeros((height, width))
    for row in prange(height):
        values, steps = np.empty(8), np.empty(8)
        for column in range(width):
            if not wanted[row, column]:
                continue
            count = 0
            smallest, second = np.inf, np.inf
            for d_row, d_column in _DIRECTIONS:
                # prange counts in unsigned integers, and unsigned plus signed would be a float.
                y, x = np.int64(row), np.int64(column)
                for step in range(1, max_steps + 1):
                    x += d_column * stretches[wrapped_row(y, height)]
                    y += d_row
                    in_row, in_column = wrapped_row(y, height), wrapped_column(y, x, height, width)
                    if trusted[in_row, in_column]:
                        value = inverse[in_row, in_column]
                        # A diagonal step is longer.
                        values[count] = value
                        steps[count] = step * math.sqrt(float(d_row * d_row + d_column * d_column))
                        count += 1
                        if value < smallest:
                            smallest, second = value, smallest
                        elif value < second:
                            second = value
                        break
            if count < 2:  # one neighbour alone may be the occluder
                continue
            total, weight, nearest = 0.0, 0.0, np.inf
            for idx in range(count):
                if values[idx] <= max_ratio * second:
                    total += values[idx] / steps[idx]
                    weight += 1 / steps[idx]
                    nearest = min(nearest, steps[idx])
            filled[row, column], distances[row, column] = total / weight, nearest
    return filled, distances
