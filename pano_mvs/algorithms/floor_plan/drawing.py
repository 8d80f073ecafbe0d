"""Draw a floor plan: orthophoto, wall lines, cameras and a scale bar."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.floor_plan.plan_grid import Extent
from pano_mvs.core.arrays import FloatArray

_PAPER, _INK, _CAMERA = (255, 255, 255), (24, 32, 56), (214, 72, 36)
_STRIP_SHARE, _MIN_STRIP_PX = 0.06, 36
_BAR_SHARE = 0.25
_SUBPIXEL_BITS = 4


def bar_length(width: float) -> float:
    """Return a round length (1, 2 or 5 times a power of ten) of at most a quarter of a width.

    >>> bar_length(10.0), bar_length(0.9)
    (2.0, 0.2)
    """
    limit = _BAR_SHARE * width
    power = 10.0 ** np.floor(np.log10(limit))
    return float(max(step * power for step in (1, 2, 5) if step * power <= limit))


def strip_px(size_hw: tuple[int, int]) -> int:
    """Return the rows of the strip for the scale bar below a plan of a size."""
    return max(_MIN_STRIP_PX, round(_STRIP_SHARE * max(size_hw)))


def draw_plan(
    photo: NDArray[np.uint8],
    known: NDArray[np.bool_],
    extent: Extent,
    *,
    walls: FloatArray,
    cameras: FloatArray,
    unit: str,
) -> NDArray[np.uint8]:
    """Return the picture of a plan (H + strip, W, 3) RGB: the strip below the plan has the scale bar.

    `photo`: (H, W, 3) RGB orthophoto. `known`: (H, W) pixels that show something; others are white. `extent`: of the
    orthophoto. `walls`: (N, 2, 2) ends of wall lines. `cameras`: (M, 2) positions of cameras. `unit`: of lengths,
    beside the scale bar.
    """
    height, width = extent.size_hw
    image = np.full((height + strip_px(extent.size_hw), width, 3), _PAPER, np.uint8)
    image[:height][known] = photo[known]
    thickness = max(2, round(width / 350))
    for x1, y1, x2, y2 in _subpixels(extent.pixels_from_xy(walls)).reshape(-1, 4).tolist():
        cv2.line(image, (x1, y1), (x2, y2), _INK, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    radius = max(3, width // 150) << _SUBPIXEL_BITS
    for x, y in _subpixels(extent.pixels_from_xy(cameras)).reshape(-1, 2).tolist():
        cv2.circle(image, (x, y), radius, _PAPER, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.circle(image, (x, y), int(0.7 * radius), _CAMERA, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    image[height:] = _PAPER
    _draw_bar(image[height:], extent.pixel, unit)
    return image


def _draw_bar(strip: NDArray[np.uint8], pixel: float, unit: str) -> None:
    rows, columns = strip.shape[:2]
    length = bar_length(columns * pixel)
    left, right, middle = rows // 3, rows // 3 + round(length / pixel), rows // 2
    tick = max(3, rows // 8)
    thickness = max(1, rows // 24)
    for start, end in (
        ((left, middle), (right, middle)),
        ((left, middle - tick), (left, middle + tick)),
        ((right, middle - tick), (right, middle + tick)),
    ):
        cv2.line(strip, start, end, _INK, thickness)
    size = rows / 60
    place = (right + rows // 4, middle + round(8 * size))
    cv2.putText(strip, f"{length:g} {unit}", place, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, thickness, cv2.LINE_AA)


def _subpixels(xy: FloatArray) -> NDArray[np.int64]:
    """Return positions as OpenCV's fixed-point numbers, whose pixels have their centres at whole numbers."""
    return np.rint((xy - 0.5) * (1 << _SUBPIXEL_BITS)).astype(np.int64)
