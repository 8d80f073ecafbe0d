"""Compiled: connected surfaces of a range map on the sphere."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import wrapped_column


@kernel
def _root(parents: NDArray[np.int64], index: int) -> int:
    while parents[index] != index:
        parents[index] = parents[parents[index]]
        index = parents[index]
    return index


@kernel
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
