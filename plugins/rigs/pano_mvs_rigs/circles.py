"""The image circle of a fisheye lens, found in its pictures by their dark surround."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray, Picture

_DIRECTIONS = 720


@dataclass(frozen=True)
class ImageCircle:
    """The image circle of a lens."""

    center_xy: tuple[float, float]  # its centre in pixels
    radius_px: float
    residual_px: float  # median distance of the edge from the circle
    seen: float  # share of the circumference where the edge was found


def brightest(pictures: Iterable[Picture]) -> NDArray[np.uint8]:
    """Return the brightest value of each pixel in the pictures of one lens, (H, W) uint8, over colours as well."""
    result: NDArray[np.uint8] | None = None
    for picture in pictures:
        value = picture.max(axis=-1)
        result = value if result is None else np.maximum(result, value)
    assert result is not None
    return result


def find_circle(brightness: NDArray[np.uint8]) -> ImageCircle | None:
    """Return the circle beyond which all pictures of a lens are dark, or None if there is none.

    From each side, the outermost bright pixel is found along lines to the middle of the picture, and a circle is fitted
    robustly to these.

    Args:
        brightness: (H, W) uint8, see `brightest`.
    """
    height, width = brightness.shape
    scale = min(1.0, 1000 / max(height, width))
    size_xy = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(brightness, size_xy, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.5).astype(np.float64)
    middle = np.array(size_xy) / 2
    angles = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    across = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    # Lines end at the border of the picture.
    reach = np.min(middle / np.maximum(np.abs(across), 1e-9), axis=1) - 1
    steps = np.arange(int(np.hypot(*middle)))
    places = (middle + steps[:, None, None] * across - 0.5).astype(np.float32)
    line = cv2.remap(smooth, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = np.median(line[: int(0.3 * min(size_xy))])
    dark = float(np.percentile(_corners(smooth), 50))
    # A pixel belongs to the circle if it is brighter than the surround by this share of the brightness inside.
    level = dark + max(12.0, 0.12 * (inside - dark))
    bright = (line > level) & (steps[:, None] <= reach)
    last = len(steps) - 1 - np.argmax(bright[::-1], axis=0)
    found = bright.any(axis=0) & (last < reach - 2) & (inside > level)
    # A circle that the border of the picture cuts must be seen along a third of its circumference.
    if found.mean() < 1 / 3:
        return None
    columns = np.flatnonzero(found)
    before, after = line[last[columns], columns], line[last[columns] + 1, columns]
    edge = last[columns] + np.clip((before - level) / np.maximum(before - after, 1e-9), 0, 1)
    points = middle + edge[:, None] * across[columns]
    start = np.array([*middle, np.median(edge)])
    fit = scipy.optimize.least_squares(_distances, start, args=(points,), loss="cauchy", f_scale=0.5)
    residual = float(np.median(np.abs(_distances(fit.x, points))))
    if residual > 0.01 * fit.x[2]:
        return None
    x, y, radius = fit.x / scale
    return ImageCircle((float(x), float(y)), float(radius), residual / scale, float(found.mean()))


def _distances(circle: FloatArray, points: FloatArray) -> FloatArray:
    away: FloatArray = np.hypot(*(points - circle[:2]).T) - circle[2]
    return away


def _corners(smooth: FloatArray) -> FloatArray:
    side = max(1, min(smooth.shape) // 20)
    ends = (slice(None, side), slice(-side, None))
    return np.concatenate([smooth[rows, columns].ravel() for rows in ends for columns in ends])
