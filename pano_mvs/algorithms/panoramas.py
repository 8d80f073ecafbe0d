"""Panoramas as arrays: windows across seam and poles, sums over isotropic ones, smaller copies, and sharpness."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray, FloatImage, Mask, Picture
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene.masking import placed_mask

Scalar = TypeVar("Scalar", bound=np.generic)


def largest_channel(values: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return the largest value of the last axis, (...,) of (..., C), NaN if one is; C is small.

    It compares whole channels. `max` over a short last axis takes about ten times as long.
    """
    largest: NDArray[Any] = values[..., 0]
    for channel in range(1, values.shape[-1]):
        largest = np.maximum(largest, values[..., channel])
    return largest


def filtered(picture: NDArray[Any], margin: int, apply: Callable[[NDArray[Any]], NDArray[Any]]) -> NDArray[Any]:
    """Return a panorama after a filter of pictures that reads `margin` pixels around, as if there were no border."""
    result = apply(np.ascontiguousarray(pad_panorama(picture, margin)))
    return np.asarray(result)[margin:-margin, margin:-margin]


def square_window(radius: int) -> NDArray[np.uint8]:
    """Return the window of OpenCV's morphology with `radius` pixels on either side of the centre."""
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def contrast_around(picture: Picture, radius: int) -> NDArray[np.int16]:
    """Return the largest difference of a channel within a square window, (H, W), in grey levels."""
    window = square_window(radius)
    contrast = filtered(
        picture, radius, lambda padded: cv2.dilate(padded, window).astype(np.int16) - cv2.erode(padded, window)
    )
    return largest_channel(contrast) if contrast.ndim == 3 else contrast


def mean_around(picture: Picture) -> FloatImage:
    """Return the mean of 3×3 pixels, (H, W, 3) float32, which suppresses noise."""
    mean = filtered(picture, 1, lambda padded: cv2.blur(padded.astype(np.float32), (3, 3)))
    return np.ascontiguousarray(mean)


def squarely_dilated(pixels: Mask, radius: int) -> Mask:
    """Return pixels, (H, W), and those within a square window around them."""
    if radius == 0:
        return pixels
    return filtered(pixels.astype(np.uint8), radius, lambda padded: cv2.dilate(padded, square_window(radius))) > 0


def reduced_panorama(picture: Picture, width_px: int) -> Picture:
    """Return a panorama (H, W, 3) at `width_px` columns; a smaller one is returned unchanged."""
    if picture.shape[1] <= width_px:
        return picture
    return np.asarray(cv2.resize(picture, (width_px, width_px // 2), interpolation=cv2.INTER_AREA), np.uint8)


def reduced_mask(mask: Mask, width_px: int) -> Mask:
    """Return a mask (H, W) at `width_px` columns: True where a small pixel has no ignored pixel in it."""
    height, width = mask.shape
    if width <= width_px:
        return mask
    return placed_mask(mask, (width_px // 2, width_px), of=(0, 0, width, height), whole_hw=(height, width))


def nearest_resized(values: NDArray[Any], size_hw: tuple[int, ...]) -> NDArray[Any]:
    """Return values (H, W) at another size, those of the nearest pixels."""
    rows, columns = (np.arange(new) * old // new for old, new in zip(values.shape, size_hw, strict=True))
    return np.asarray(values[rows[:, None], columns])


def narrowed(values: NDArray[Any], width: int) -> NDArray[Any]:
    """Return values (H, W) that are at most `width` wide, those of the nearest pixels."""
    height = max(1, round(values.shape[0] * width / values.shape[1]))
    return values if values.shape[1] <= width else nearest_resized(values, (height, width))


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


_WIDEST = 2048


def sharpness(picture: NDArray[np.uint8]) -> float:
    """Return the sharpness of a panorama: the variance of its Laplacian over that of its grey levels.

    Only a band of 45° around the equator is used: rows near the poles are stretched, and show tripods and sky. The
    division makes frames with different exposure comparable. Only frames of the same scene are comparable.

    `picture`: (H, W, 3) uint8, in any order of the channels; the seam wraps.

    Returns:
        A number that is 0 for an image without structure, and decreases with motion blur and defocus.

    Source: Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy: a comparative study", ICPR 2000,
    section 2 (variance of the Laplacian).
    """
    height, width = picture.shape[:2]
    band = cv2.cvtColor(picture[height // 4 : height - height // 4], cv2.COLOR_BGR2GRAY)
    if width > _WIDEST:
        band = cv2.resize(band, (_WIDEST, round(band.shape[0] * _WIDEST / width)), interpolation=cv2.INTER_AREA)
    grey = np.pad(band.astype(np.float32), ((0, 0), (1, 1)), mode="wrap")
    contrast = float(grey[:, 1:-1].var())
    if contrast == 0.0:
        return 0.0
    return float(cv2.Laplacian(grey, cv2.CV_32F)[1:-1, 1:-1].var()) / contrast
