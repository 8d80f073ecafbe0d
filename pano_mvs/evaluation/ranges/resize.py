"""Resampling of range maps to another size without ranges between two surfaces."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pad_panorama

Scalar = TypeVar("Scalar", bound=np.generic)

# Largest relative difference of four neighbouring ranges on one surface.
_ONE_SURFACE = 0.1


def resized_range(ranges: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Return a range map at the pixel centres of another size.

    If the four pixels around a place lie on one surface (all have a range, within 10 % of each other), 1 / range is
    interpolated bilinearly: on a plane it is nearly linear. Elsewhere, at edges of objects and holes, the pixel that
    contains the place is used, so that no range between two surfaces arises and no hole shrinks.

    Args:
        ranges: (H, W) float32 of a full sphere, NaN invalid, even W.
        size_hw: (height, width) of the result, of the same aspect ratio.

    Returns:
        (height, width) float32; the map itself if it has that size.

    Raises:
        UsageError: if the aspect ratios differ.
    """
    if ranges.shape == size_hw:
        return ranges
    nearest = resized_labels(ranges, size_hw)
    y, x = ((np.arange(new) + 0.5) * old / new + 0.5 for new, old in zip(size_hw, ranges.shape, strict=True))
    row, column = np.floor(y).astype(np.intp), np.floor(x).astype(np.intp)
    down, right = (y - row)[:, None], (x - column)[None, :]
    padded = pad_panorama(ranges.astype(np.float64), 1)
    corners = [padded[np.ix_(row + below, column + beside)] for below in (0, 1) for beside in (0, 1)]
    near, far = np.minimum.reduce(corners), np.maximum.reduce(corners)  # NaN where any of the four is
    shares = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    one_surface = far <= near * (1 + _ONE_SURFACE)
    inverse = sum(share / np.where(one_surface, corner, 1.0) for share, corner in zip(shares, corners, strict=True))
    return np.where(one_surface, 1 / inverse, nearest).astype(np.float32)


def resized_labels(labels: NDArray[Scalar], size_hw: tuple[int, int]) -> NDArray[Scalar]:
    """Return a map of labels at the pixel centres of another size: the pixel that contains each centre.

    Args:
        labels: (H, W) of a full sphere.
        size_hw: (height, width) of the result, of the same aspect ratio.

    Raises:
        UsageError: if the aspect ratios differ.
    """
    height, width = labels.shape
    if height * size_hw[1] != width * size_hw[0]:
        raise UsageError(
            f"a map of {width}×{height} px cannot be compared with one of {size_hw[1]}×{size_hw[0]}: "
            "both must be full panoramas, twice as wide as high"
        )
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(np.intp) for new, old in zip(size_hw, labels.shape, strict=True)
    )
    return labels[np.ix_(rows, columns)]
