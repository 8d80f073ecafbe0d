"""The median and the Gaussian filter on range maps, and the removal of small isolated surfaces."""

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
from pano_mvs.geometry import pad_panorama, pixel_solid_angle
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
    if window in (3, 5):  # which OpenCV supports for floats, ten times faster than a sort
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


@checks_settings
def remove_speckles(
    range_map: RangeMap,
    *,
    max_size_px: Annotated[float, Setting("remove smaller surfaces; area in pixels at the equator", gt=0)] = 60.0,
    max_relative_step: Annotated[float, Setting("maximum relative step between pixels of one surface", gt=0)] = 0.03,
) -> RangeMap:
    """Remove connected surfaces up to a given solid angle.

    Adjacent pixels (across the seam and the poles) belong to one surface if their ranges differ by at most
    `max_relative_step`. The size of a surface is the sum of its pixels' solid angles.

    Args:
        range_map: (H, W) with even W, the full sphere.

    Raises:
        UsageError: if a limit is out of bounds.
    """
    from pano_mvs.algorithms.filters.kernels_fill import label_surfaces  # compiles on import

    height, width = range_map.range.shape
    # Copied, since the kernel is compiled once more for arrays that are read-only.
    labels = label_surfaces(np.array(range_map.range, order="C"), max_relative_step)
    seen = labels >= 0
    equator_px = pixel_solid_angle((height, width)) * height * width / (2 * np.pi**2)
    sizes = np.bincount(labels[seen], weights=np.repeat(equator_px, width)[seen], minlength=height * width)
    small = seen & (sizes[np.maximum(labels, 0)] <= max_size_px)
    removed = small.reshape(height, width)
    ranges: NDArray[np.float32] = np.where(removed, np.float32(np.nan), range_map.range)
    return with_ranges(range_map, ranges, np.where(removed, np.uint8(0), range_map.confidence))
