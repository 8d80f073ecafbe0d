"""The Gaussian filter on range maps, across the seam and the poles."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np

from pano_mvs.algorithms.filters.replacement import with_ranges
from pano_mvs.algorithms.filters.settings import Window
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
        window: odd width and height of the square window in pixels.
        sigma_px: standard deviation of the Gaussian in pixels.

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
