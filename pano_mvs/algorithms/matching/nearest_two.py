"""Find the two nearest neighbours of each descriptor by Euclidean distance; of small integers by exact products."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_RATIO = 0.8  # of the distances to the nearest and the second nearest, by default (Lowe 2004, section 7.1)


@dataclass(frozen=True, slots=True, eq=False)
class NearestTwo:
    """The nearest neighbours of N descriptors of one image among M of another, with squared distances."""

    nearest: NDArray[np.intp]  # (N,) position of the nearest one; the first of equally near ones
    squared: NDArray[np.float32]  # (N,) float32, to the nearest one
    next_squared: NDArray[np.float32]  # (N,) float32, to the second nearest one
    squared_back: NDArray[np.float32]  # (M,) float32, from each descriptor of the other image to its nearest one

    def mutual(self) -> NDArray[np.bool_]:
        """Return which pass the ratio test and are mutually the nearest, (N,)."""
        distinct = self.squared < np.float32(MAX_RATIO**2) * self.next_squared
        return np.asarray(distinct & (self.squared <= self.squared_back[self.nearest]))


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
    for start in range(0, len(a), 256):
        rows = slice(start, start + 256)
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


_FAR = 1 << 29
"""Squared length of what pads the last block, larger than sums of products, below 3 × 2^27."""


def can_compare_as_integers(descriptors: NDArray[np.generic]) -> bool:
    """Return whether descriptors (N, D) are integers small enough for an exact comparison on this machine."""
    from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR

    if not HAS_VECTOR:
        return False
    # The comparison is also false for NaN.
    greatest = max(float(descriptors.max(initial=0)), -float(descriptors.min(initial=0)))
    if not greatest**2 * descriptors.shape[1] <= 1 << 27:
        return False
    return np.array_equal(descriptors, descriptors.astype(np.int16))


class Comparable:
    """Descriptors (N, D), packed once for many exact comparisons if they and the machine allow these."""

    def __init__(self, descriptors: NDArray[np.generic]) -> None:
        self.descriptors = descriptors
        whole = descriptors.size > 0 and can_compare_as_integers(descriptors)
        self._packed = PackedDescriptors.of(descriptors) if whole else None

    def nearest_two(self, other: Comparable) -> NearestTwo:
        """Return the two nearest neighbours of each among M ≥ 2 others of the same length."""
        first, second = self._packed, other._packed
        if first is not None and second is not None and first.rows.dtype == second.rows.dtype:
            return nearest_two_packed(first, second)
        return nearest_two(self.descriptors, other.descriptors)


@dataclass(frozen=True, slots=True, eq=False)
class PackedDescriptors:
    """Descriptors in the memory layout of the compiled comparison, to be compared with many others."""

    count: int  # number of descriptors, N
    rows: NDArray[np.int16] | NDArray[np.uint8]  # (padded N, padded D)
    columns: NDArray[np.int16] | NDArray[np.int8]  # likewise in blocks of columns, with 4 bytes of each together
    row_squares: NDArray[np.int32]  # (padded N,) int32 squared lengths, less what the products of bytes lack
    column_squares: NDArray[np.int32]  # (padded number of columns,) int32 squared lengths

    @classmethod
    def of(cls, descriptors: NDArray[np.generic]) -> PackedDescriptors:
        """Return descriptors (N, D) packed, for which `can_compare_as_integers` is true."""
        from pano_mvs.algorithms.matching import kernels_vector_match as kernels

        count = len(descriptors)
        of_bytes = kernels.HAS_BYTES and descriptors.min() >= 0 and descriptors.max() <= 255
        rows = _filled_up(descriptors, kernels.ROWS, np.dtype(np.uint8 if of_bytes else np.int16))
        columns = _filled_up(rows[:count], kernels.COLUMNS, rows.dtype)
        squares = _squares(rows, count)
        column_squares = np.full(len(columns), _FAR, np.int32)
        column_squares[:count] = squares[:count]
        if of_bytes:
            columns ^= 128  # a byte less 128, with a sign
            squares -= 256 * rows.sum(axis=1, dtype=np.int32)
        fours = columns.view(np.int32).reshape(-1, kernels.COLUMNS, columns.shape[1] * columns.itemsize // 4)
        packed: NDArray[Any] = np.ascontiguousarray(fours.transpose(0, 2, 1)).view(np.int8 if of_bytes else np.int16)
        shape = (*fours.transpose(0, 2, 1).shape, -1)
        return cls(count, rows, packed.reshape(shape), squares, column_squares)


def nearest_two_packed(first: PackedDescriptors, second: PackedDescriptors) -> NearestTwo:
    """Return the result of `nearest_two` without rounding; `second` has M ≥ 2 descriptors of the same length."""
    from pano_mvs.algorithms.matching import kernels_vector_match as kernels

    state = np.full((len(first.rows), 3, kernels.LANES), -2 * _FAR, np.int32)
    column_best = np.full(len(second.column_squares), -2 * _FAR, np.int32)
    kernels.compare_all(first.rows, second.columns, first.row_squares, second.column_squares, state, column_best)
    best, second_best, nearest = _over_lanes(state[: first.count])
    squares = first.row_squares[: first.count]
    return NearestTwo(
        nearest=nearest,
        squared=(squares - best).astype(np.float32),
        next_squared=(squares - second_best).astype(np.float32),
        squared_back=(second.column_squares - column_best)[: second.count].astype(np.float32),
    )


def _filled_up(descriptors: NDArray[np.generic], multiple: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return descriptors as whole numbers, zero-padded to a multiple of rows and of four bytes in a row."""
    count, size = descriptors.shape
    step = 4 // dtype.itemsize
    filled = np.zeros((-(-count // multiple) * multiple, -(-size // step) * step), dtype)
    filled[:count, :size] = descriptors
    return filled


def _squares(descriptors: NDArray[Any], count: int) -> NDArray[np.int32]:
    """Return the squared lengths; those after the first `count` are larger than any distance."""
    squares = np.full(len(descriptors), _FAR, np.int32)
    squares[:count] = np.einsum("nd,nd->n", descriptors[:count], descriptors[:count], dtype=np.int32)
    return squares


def _over_lanes(state: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.intp]]:
    """Return the largest and second largest value of each row, and the first column of the largest."""
    best, second, column = state.transpose(1, 0, 2)
    greatest = best.max(axis=1)
    nearest = np.where(best == greatest[:, None], column, np.iinfo(np.int32).max).min(axis=1).astype(np.intp)
    others = best.copy()
    lanes = best.shape[1]
    others[np.arange(len(best)), nearest % lanes] = second[np.arange(len(best)), nearest % lanes]
    return greatest, np.maximum(others.max(axis=1), second.max(axis=1)), nearest
