"""Sample a pinhole view from a panorama, across its seam and poles."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import PinholeView, pad_panorama, pixel_from_ray

_PAD_PX = 4
_BAND_ROWS = 256


def sample_view(
    panorama: NDArray[np.uint8],
    view: PinholeView,
    *,
    interpolation: int = cv2.INTER_CUBIC,
    samples: int = 1,
) -> NDArray[np.uint8]:
    """Return a view's image, (h, w) or (h, w, C) uint8, from a panorama (H, W) or (H, W, C), across seam and poles.

    Args:
        panorama: the full sphere, even W.
        view: the pinhole view.
        interpolation: OpenCV's constant for nearest, linear or cubic interpolation.
        samples: number of evenly spread samples in each pixel along each side, which are averaged.
    """
    padded = pad_panorama(panorama, min(_PAD_PX, *panorama.shape[:2]))
    # OpenCV puts (0, 0) at the first pixel's centre.
    shift = min(_PAD_PX, *panorama.shape[:2]) - 0.5
    result = np.empty((*view.size_hw, *panorama.shape[2:]), np.uint8)
    for rows in _bands(view.size_hw[0]):
        total = np.zeros(result[rows].shape, np.float32)
        for offset_xy in _offsets(samples):
            pixels = (pixel_from_ray(view.rays(rows, offset_xy=offset_xy), _size(panorama)) + shift).astype(np.float32)
            total += cv2.remap(padded, pixels[..., 0], pixels[..., 1], interpolation)
        result[rows] = np.rint(total / samples**2)
    return result


def nearest_pixels(
    view: PinholeView, size_hw: tuple[int, int], *, offset_xy: tuple[float, float] = (0.5, 0.5)
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return row and column, (h, w) each, of the panorama's pixel that contains a position in each of a view's pixels.

    Args:
        view: the pinhole view.
        size_hw: (height, width) of the panorama.
        offset_xy: the position within a pixel; (0.5, 0.5) is its centre.
    """
    row, column = np.empty(view.size_hw, np.intp), np.empty(view.size_hw, np.intp)
    for rows in _bands(view.size_hw[0]):
        whole = np.floor(pixel_from_ray(view.rays(rows, offset_xy=offset_xy), size_hw)).astype(np.intp)
        row[rows] = np.minimum(whole[..., 1], size_hw[0] - 1)
        column[rows] = whole[..., 0] % size_hw[1]
    return row, column


def _offsets(samples: int) -> Iterator[tuple[float, float]]:
    """Yield evenly spread positions in a pixel."""
    for y in range(samples):
        for x in range(samples):
            yield (x + 0.5) / samples, (y + 0.5) / samples


def _bands(height: int) -> Iterator[slice]:
    """Yield bands of rows, so that the rays of a large view are never all in memory."""
    for first in range(0, height, _BAND_ROWS):
        yield slice(first, min(first + _BAND_ROWS, height))


def _size(panorama: NDArray[np.generic]) -> tuple[int, int]:
    return panorama.shape[0], panorama.shape[1]
