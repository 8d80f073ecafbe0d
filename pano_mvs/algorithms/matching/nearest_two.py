"""Find the two nearest neighbours of each descriptor by Euclidean distance, and the nearest distances back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_BLOCK_ROWS = 256


@dataclass(frozen=True, slots=True, eq=False)
class NearestTwo:
    """The nearest neighbours of N descriptors of one image among M of another, with squared distances."""

    nearest: NDArray[np.intp]  # (N,) position of the nearest one; the first of equally near ones
    squared: NDArray[np.float32]  # (N,) float32, to the nearest one
    next_squared: NDArray[np.float32]  # (N,) float32, to the second nearest one
    squared_back: NDArray[np.float32]  # (M,) float32, from each descriptor of the other image to its nearest one


def nearest_two(first: NDArray[np.generic], second: NDArray[np.generic]) -> NearestTwo:
    """Return the two nearest neighbours of each descriptor: |a − b|² = |a|² + |b|² − 2 a·b, in blocks of rows.

    Args:
        first: (N, D).
        second: (M, D), M at least 2.
    """
    a, b = first.astype(np.float32, copy=False), second.astype(np.float32, copy=False)
    half_a, half_b = 0.5 * np.sum(a**2, axis=1), 0.5 * np.sum(b**2, axis=1)
    nearest = np.empty(len(a), np.intp)
    best, runner_up = np.empty(len(a), np.float32), np.empty(len(a), np.float32)
    best_back = np.full(len(b), -np.inf, np.float32)
    for start in range(0, len(a), _BLOCK_ROWS):
        rows = slice(start, start + _BLOCK_ROWS)
        # a·b − |a|²/2 − |b|²/2 is minus half of the squared distance.
        closeness = a[rows] @ b.T
        closeness -= half_b
        closeness -= half_a[rows, None]
        row_idx = np.arange(len(closeness))
        nearest[rows] = closeness.argmax(axis=1)
        best[rows] = closeness[row_idx, nearest[rows]]
        np.maximum(best_back, closeness.max(axis=0), out=best_back)
        closeness[row_idx, nearest[rows]] = -np.inf
        runner_up[rows] = closeness.max(axis=1)
    return NearestTwo(nearest, -2 * best, -2 * runner_up, -2 * best_back)
