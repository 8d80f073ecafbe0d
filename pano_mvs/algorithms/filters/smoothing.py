"""The median and the Gaussian filter on range maps, across the seam and the poles."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.data_term import Window
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.panoramas import square_window
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene import RangeMap


@checks_settings
def gaussian_range(
    range_map: RangeMap,
    *,
    window: Window = 5,
    sigma_px: Annotated[float, Setting("standard deviation in pixels (the paper: 1.1)", gt=0)] = 1.1,
) -> RangeMap:
    """Smooth a range map by a Gaussian over its valid pixels (normalised convolution).

    r'(u) = Σ g(u − v) r(v) / Σ g(u − v), both sums over the valid v in the window (Knutsson and Westin, "Normalized and
    differential convolution", 1993). Invalid pixels stay invalid; the confidence does not change. The filter does not
    preserve edges between surfaces.

    Args:
        range_map: (H, W) with even W, the full sphere.

    Raises:
        UsageError: if a setting is out of bounds.
    """
    pad = window // 2
    padded = pad_panorama(range_map.range, pad).astype(np.float64)
    valid = np.isfinite(padded)
    height, width = range_map.range.shape
    weighted, weight = (
        cv2.GaussianBlur(values, (window, window), sigma_px)[pad : pad + height, pad : pad + width]
        for values in (np.where(valid, padded, 0.0), valid.astype(np.float64))
    )
    kept = range_map.valid
    smoothed = np.full((height, width), np.nan, np.float32)
    smoothed[kept] = weighted[kept] / weight[kept]
    return with_ranges(range_map, smoothed)


# OpenCV supports float images with these window sizes only, ten times faster than a sort.
_OPENCV_WINDOWS = (3, 5)


@checks_settings
def median_range(range_map: RangeMap, *, window: Window = 5) -> RangeMap:
    """Replace each valid range by the median of the valid ranges around it.

    Invalid pixels are ignored and stay invalid; the confidence does not change. Of an even number of ranges, the nearer
    of the two middle ones is used, since their mean might be on neither of two surfaces.

    Args:
        range_map: (H, W) with even W, the full sphere.

    Raises:
        UsageError: if the window is out of bounds or wider than the panorama.
    """
    padded = pad_panorama(range_map.range, window // 2)
    if window in _OPENCV_WINDOWS:
        inner = slice(window // 2, -(window // 2))
        filtered = cv2.medianBlur(np.nan_to_num(padded), window)[inner, inner].copy()
        holes = cv2.dilate(np.isnan(padded).astype(np.uint8), square_window(window // 2))[inner, inner]
        holed = (holes > 0) & range_map.valid
        filtered[holed] = _median_of_windows(sliding_window_view(padded, (window, window))[holed])
    else:
        filtered = np.empty_like(range_map.range)
        for row, windows in enumerate(sliding_window_view(padded, (window, window))):
            filtered[row] = _median_of_windows(windows)
    filtered[~range_map.valid] = np.nan
    return with_ranges(range_map, filtered)


def _median_of_windows(windows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the lower median of the valid values of each window, (..., k, k) to (...,); NaN if there is none."""
    values = np.sort(windows.reshape(*windows.shape[:-2], windows.shape[-1] ** 2), axis=-1)  # NaN sorts last
    count = np.isfinite(values).sum(axis=-1, keepdims=True)
    median: NDArray[np.float32] = np.take_along_axis(values, np.maximum(count - 1, 0) // 2, axis=-1)[..., 0]
    return median
