"""Distinguish raw recordings of two-lens cameras from stitched equirectangular panoramas."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_SIZE_HW = (128, 256)
_DARK, _BRIGHT = 24, 40
_MIN_DARK_SHARE = 0.97


def is_dual_fisheye(picture: NDArray[np.uint8]) -> bool:
    """Return whether an image with aspect ratio 2:1 shows two fisheye circles side by side instead of a panorama.

    Such an image is black outside of the two circles, at the top and the bottom, but not inside of them. In a panorama,
    the same areas are bands around the seam and the middle from pole to pole, and contain sky and floor.

    Args:
        picture: (H, 2 H, 3) uint8.
    """
    grey = cv2.cvtColor(cv2.resize(picture, _SIZE_HW[::-1], interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
    rows, columns = np.mgrid[: _SIZE_HW[0], : _SIZE_HW[0]]
    radius = np.hypot(rows + 0.5 - _SIZE_HW[0] / 2, columns + 0.5 - _SIZE_HW[0] / 2) / (_SIZE_HW[0] / 2)
    inside, outside = np.tile(radius < 0.9, 2), np.tile(radius > 1.1, 2)
    upper, lower = outside.copy(), outside.copy()
    upper[_SIZE_HW[0] // 2 :] = lower[: _SIZE_HW[0] // 2] = False
    dark = grey < _DARK
    is_dark_around = min(dark[upper].mean(), dark[lower].mean()) > _MIN_DARK_SHARE
    return bool(is_dark_around and np.median(grey[inside]) > _BRIGHT)
