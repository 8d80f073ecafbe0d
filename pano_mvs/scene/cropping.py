"""Cropped panoramas: pictures of a part of the sphere, put where they belong to a fraction of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# (left, top, width, height) in pixels of the whole sphere.
Crop = tuple[int, int, int, int]


def same_shape(one_hw: tuple[int, ...], other_hw: tuple[int, ...]) -> bool:
    """Return whether two sizes are one picture at two resolutions, but for rounding to whole pixels."""
    (height, width), (other_height, other_width) = one_hw, other_hw
    return abs(height * other_width - width * other_height) <= max(height, width, other_height, other_width)


def inside_crop(size_hw: tuple[int, int], crop_ltwh: Crop, whole_hw: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of a panorama of `size_hw` of which a cropped picture holds every bit.

    Args:
        size_hw: height and width of the panorama, the full sphere.
        crop_ltwh: what the picture holds, in pixels of the sphere at `whole_hw`.
        whole_hw: height and width of that sphere.
    """
    left, top, width, height = crop_ltwh
    return _inner(size_hw[0], whole_hw[0], top, height), _inner(size_hw[1], whole_hw[1], left, width)


def placed_picture(
    picture: NDArray[np.uint8], size_hw: tuple[int, int], *, of: Crop, whole_hw: tuple[int, int]
) -> NDArray[np.uint8]:
    """Return a cropped picture as a panorama, (H, W, 3), each pixel the mean of what it covers; black elsewhere.

    Args:
        picture: (h, w, 3); another size than that of `of` if it was resized since.
        size_hw: (H, W) that is wanted, of the full sphere.
        of: what the picture covers, in pixels of the sphere at `whole_hw`.
        whole_hw: height and width of that sphere.
    """
    left, top, width, height = of
    if picture.shape[:2] == (height, width):
        sphere = np.zeros((*whole_hw, 3), np.uint8)
        sphere[top : top + height, left : left + width] = picture
        if whole_hw == size_hw:
            return sphere
        return np.asarray(cv2.resize(sphere, size_hw[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    rows, columns = inside_crop(size_hw, of, whole_hw)
    part = _means(picture.astype(np.float32), rows, size_hw[0], whole_hw[0], top, height)
    part = _means(np.swapaxes(part, 0, 1), columns, size_hw[1], whole_hw[1], left, width)
    sphere = np.zeros((*size_hw, 3), np.uint8)
    sphere[rows, columns] = np.rint(np.swapaxes(part, 0, 1)).astype(np.uint8)
    return sphere


def _means(
    picture: NDArray[np.float32], wanted: slice, count: int, whole: int, first: int, length: int
) -> NDArray[np.float32]:
    """Return the mean of the rows that each wanted row covers; over one row at least, which interpolates linearly."""
    from scipy.sparse import csr_array  # slow to import, and seldom needed

    pixels = len(picture)
    edges = (np.arange(wanted.start, wanted.stop + 1) * whole / count - first) * pixels / length
    middles, half = (edges[:-1] + edges[1:]) / 2, max(edges[1] - edges[0], 1.0) / 2
    starts = np.floor(middles - half).astype(np.int64)
    touched = starts[:, None] + np.arange(int(np.ceil(2 * half)) + 1)
    overlap = np.minimum(touched + 1, (middles + half)[:, None]) - np.maximum(touched, (middles - half)[:, None])
    weights = np.maximum(overlap, 0) / (2 * half)
    lines = np.broadcast_to(np.arange(len(middles))[:, None], touched.shape)
    indices = lines.ravel(), np.clip(touched, 0, pixels - 1).ravel()
    matrix = csr_array((weights.ravel().astype(np.float32), indices), (len(middles), pixels))
    means = matrix @ picture.reshape(pixels, -1)
    return np.asarray(means, np.float32).reshape(len(middles), *picture.shape[1:])


def _inner(count: int, whole: int, first: int, length: int) -> slice:
    """Return the pixels of `count` on a side of `whole` that lie between `first` and `first + length`."""
    return slice(-(-first * count // whole), (first + length) * count // whole)
