"""Place cropped panoramas, which cover a part of the sphere, with subpixel accuracy."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# (left, top, width, height) in pixels of the whole sphere.
Crop = tuple[int, int, int, int]


def same_shape(one_hw: tuple[int, ...], other_hw: tuple[int, ...]) -> bool:
    """Return whether two sizes have the same aspect ratio, except for rounding to integer pixels."""
    (height, width), (other_height, other_width) = one_hw, other_hw
    return abs(height * other_width - width * other_height) <= max(height, width, other_height, other_width)


def inside_crop(size_hw: tuple[int, int], crop_ltwh: Crop, whole_hw: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of a panorama of `size_hw` that a cropped image covers completely.

    Args:
        size_hw: height and width of the panorama, the full sphere.
        crop_ltwh: the part that the image covers, in pixels of the sphere at `whole_hw`.
        whole_hw: height and width of that sphere.
    """
    left, top, width, height = crop_ltwh
    rows = _inner(size_hw[0], whole_hw[0], first=top, length=height)
    return rows, _inner(size_hw[1], whole_hw[1], first=left, length=width)


def placed_picture(
    picture: NDArray[np.uint8], size_hw: tuple[int, int], *, of: Crop, whole_hw: tuple[int, int]
) -> NDArray[np.uint8]:
    """Return a cropped image as a panorama, (H, W, 3), averaged over the area of each pixel; black elsewhere.

    Args:
        picture: (h, w, 3); its size differs from that of `of` if it was resized.
        size_hw: (H, W) of the returned full sphere.
        of: the part that the image covers, in pixels of the sphere at `whole_hw`.
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
    part = _means(picture.astype(np.float32), rows, count=size_hw[0], whole=whole_hw[0], first=top, length=height)
    part = _means(np.swapaxes(part, 0, 1), columns, count=size_hw[1], whole=whole_hw[1], first=left, length=width)
    sphere = np.zeros((*size_hw, 3), np.uint8)
    sphere[rows, columns] = np.rint(np.swapaxes(part, 0, 1)).astype(np.uint8)
    return sphere


def _means(
    picture: NDArray[np.float32], wanted: slice, *, count: int, whole: int, first: int, length: int
) -> NDArray[np.float32]:
    """Return the mean over the extent of each wanted row, which is at least one row (linear interpolation)."""
    from scipy.sparse import csr_array  # slow to import and rarely needed

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


def _inner(count: int, whole: int, *, first: int, length: int) -> slice:
    """Return the pixels of `count` on a side of `whole` that lie between `first` and `first + length`."""
    return slice(-(-first * count // whole), (first + length) * count // whole)
