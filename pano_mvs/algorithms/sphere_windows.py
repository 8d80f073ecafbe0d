"""Sums, extremes and step widths over windows that are isotropic on the sphere."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pad_panorama

Scalar = TypeVar("Scalar", bound=np.generic)


def largest_channel(values: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return the largest value of the last axis, (...,) of (..., C), NaN if one is; C is small.

    It compares whole channels. `max` over a short last axis takes about ten times as long.
    """
    largest: NDArray[Any] = values[..., 0]
    for channel in range(1, values.shape[-1]):
        largest = np.maximum(largest, values[..., channel])
    return largest


def columns_per_step(size_hw: tuple[int, int], *, steps: int) -> NDArray[np.int64]:
    """Return for each row the number of columns as wide as a pixel at the equator: 1 / cos φ, rounded, (H,) int64.

    Limited so that a window of `steps` steps covers at most the full circle.
    """
    height, width = size_hw
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    columns: NDArray[np.int64] = np.rint(1 / np.cos(elevation)).astype(np.int64)
    return np.clip(columns, 1, max(1, width // steps))


def box_sum(values: FloatArray, radius: int) -> FloatArray:
    """Return the sum over the window around each pixel, (H, W) or (H, W, C) as given; no NaN.

    The window has 2 radius + 1 rows, across the poles if necessary. The number of columns grows as columns become
    narrower than at the equator in the row of the window's centre (integers), up to the full circle.

    `values`: (H, W) or (H, W, C), the full sphere, even W. `radius`: of the window in pixels at the equator, at least 1
    and less than H / 2.
    """
    flat = _channels(values)
    return _row_sums(_column_sums(flat, radius), _half_columns(values, radius)).reshape(values.shape)


def box_spread(values: FloatArray, radius: int) -> FloatArray:
    """Return the sum over all pixels whose window contains each pixel: the transpose of `box_sum`."""
    flat = _channels(values)
    return _column_sums(_row_sums(flat, _half_columns(values, radius)), radius).reshape(values.shape)


def _channels(values: FloatArray) -> FloatArray:
    return values.reshape(*values.shape[:2], -1).astype(np.float64)


def _half_columns(values: FloatArray, radius: int) -> NDArray[np.int64]:
    height, width = values.shape[:2]
    wide = radius * columns_per_step((height, width), steps=2 * radius + 1)
    return np.asarray(np.minimum(wide, (width - 1) // 2), np.int64)


def _column_sums(values: FloatArray, radius: int) -> FloatArray:
    """Return the sums over 2 radius + 1 rows around each pixel, across the poles if necessary."""
    padded = pad_panorama(values, radius)[:, radius:-radius]
    above = np.concatenate([np.zeros_like(padded[:1]), np.cumsum(padded, axis=0)])
    return np.asarray(above[2 * radius + 1 :] - above[: -2 * radius - 1])


def _row_sums(values: FloatArray, half_columns: NDArray[np.int64]) -> FloatArray:
    """Return the sums over 2 h + 1 columns around each pixel, with a separate h for each row; rows wrap."""
    result = np.empty_like(values)
    for half in np.unique(half_columns):
        rows = half_columns == half
        part = np.pad(values[rows], ((0, 0), (half + 1, half), (0, 0)), mode="wrap")
        sums = np.cumsum(part, axis=1)
        result[rows] = sums[:, 2 * half + 1 :] - sums[:, : -2 * half - 1]
    return result
