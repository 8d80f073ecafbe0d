"""Read masks, resize them conservatively, and fill masked pixels of images."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import Mask
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene.image_file import decode_picture
from pano_mvs.scene.record import FilePart

Scalar = TypeVar("Scalar", bound=np.generic)
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


MEANING_OF_MASKS = (
    "0 (black) in a mask means ignored, any other value used: if yours show in white what to ignore, invert them"
)
_JPEG_START = b"\xff\xd8"


def decode_mask(path: Path, data: bytes | None = None) -> Mask:
    """Return a mask file as (H, W) bool, False where its value is 0: these pixels are ignored.

    The image is grey or colour (the brightest channel counts) with any depth, or has a palette (its colours count).
    Pixels that are transparent by an alpha channel are ignored too; if all colours are black, only alpha counts. In a
    JPEG, where black is not exactly 0, the threshold is half the brightness.

    Raises:
        InputError: if the file cannot be read or is not an image.
    """
    if data is None:
        data = FilePart(path).read_bytes()
    picture = decode_picture(data, path, cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"{path}: the mask is not an image that can be decoded ({len(data)} bytes). Save it as PNG")
    channels = np.atleast_3d(picture)
    has_alpha = channels.shape[2] in (2, 4)
    colors = channels[..., :-1] if has_alpha else channels
    threshold = 127 if data.startswith(_JPEG_START) else 0  # compression turns black and white into greys
    valid = np.asarray((colors > threshold).any(axis=-1))
    if not has_alpha:
        return valid
    opaque = np.asarray(channels[..., -1] > 0)
    return valid & opaque if valid.any() else opaque


def placed_mask(mask: Mask, size_hw: tuple[int, int], *, of: Crop, whole_hw: tuple[int, int]) -> Mask:
    """Return a mask at the size of a panorama, (H, W): a pixel is valid if all mask pixels that it touches are valid.

    Even a thin masked line makes every pixel invalid that it touches.

    Args:
        mask: (h, w) of any size, False is ignored.
        size_hw: (H, W) of the returned full sphere.
        of: (left, top, width, height) of what the mask covers, in pixels of the sphere at `whole_hw`; nothing
            outside of it is masked.
        whole_hw: height and width of that sphere.
    """
    left, top, width, height = of
    if mask.shape == size_hw and of == (0, 0, whole_hw[1], whole_hw[0]):
        return mask
    upper, lower = _spans(size_hw[0], whole_hw[0], first=top, length=height, pixels=mask.shape[0])
    first, last = _spans(size_hw[1], whole_hw[1], first=left, length=width, pixels=mask.shape[1])
    before = cv2.integral((~mask).astype(np.uint8), sdepth=cv2.CV_32S)
    masked = before[lower] - before[upper]
    return np.asarray(masked[:, last] == masked[:, first])


def nearest_pixels(pixels: NDArray[Scalar], size_hw: tuple[int, int]) -> NDArray[Scalar]:
    """Return a map (H, W) at another size: at each new pixel's centre, the value of the pixel that contains it."""
    rows, columns = (
        (2 * np.arange(new) + 1) * old // (2 * new) for new, old in zip(size_hw, pixels.shape, strict=True)
    )
    return np.asarray(pixels[rows[:, None], columns])


def painted_over(picture: NDArray[np.uint8], valid: Mask) -> NDArray[np.uint8]:
    """Return a panorama, (H, W, C), whose masked pixels are filled with surrounding colours.

    Each masked pixel has the mean of the valid pixels in the smallest box around it that contains any, across the seam
    and the poles; far from valid pixels, the mean of all. The result does not depend on the masked content, and has no
    edges at the mask.
    """
    painted = picture.copy()
    shown = valid.astype(np.uint8)
    if not shown.any():
        painted[...] = 128
        return painted
    # Masked pixels take the mean colour of the smallest box with valid pixels, up to this radius.
    margin = min(64, picture.shape[0])
    seen = pad_panorama(np.dstack([cv2.bitwise_and(picture, picture, mask=shown), shown]), margin)
    todo, radius = 1 - shown, 1
    while radius <= margin and todo.any():
        rows, columns = _bounds(todo)
        around = (_widened(rows, margin, radius), _widened(columns, margin, radius))
        side = 2 * radius + 1
        sums = cv2.boxFilter(np.ascontiguousarray(seen[around]), cv2.CV_32S, (side, side), normalize=False)
        sums = sums[radius:-radius, radius:-radius]
        found = (todo[rows, columns] > 0) & (sums[..., -1] > 0)
        counts = sums[found][:, -1:]
        painted[rows, columns][found] = (2 * sums[found][:, :-1] + counts) // (2 * counts)
        todo[rows, columns][found] = 0
        radius *= 2
    if todo.any():
        painted[todo > 0] = np.rint(cv2.mean(picture, mask=shown)[:3]).astype(np.uint8)
    return painted


def _spans(
    count: int, whole: int, *, first: int, length: int, pixels: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the mask pixels, start to stop, that each of `count` pixels on a side of length `whole` touches.

    The mask's `pixels` pixels cover the side from `first` over `length`.
    """
    edges = (np.arange(count + 1, dtype=np.int64) * whole - first * count) * pixels
    starts = edges[:-1] // (count * length)
    stops = -(-edges[1:] // (count * length))
    return np.clip(starts, 0, pixels), np.clip(stops, 0, pixels)


def _bounds(pixels: NDArray[np.uint8]) -> tuple[slice, slice]:
    """Return the rows and columns of the bounding box of all nonzero pixels."""
    left, top, width, height = cv2.boundingRect(pixels)
    return slice(top, top + height), slice(left, left + width)


def _widened(span: slice, margin: int, radius: int) -> slice:
    """Return a slice, extended by `radius` pixels, in the coordinates of the padded image."""
    return slice(span.start + margin - radius, span.stop + margin + radius)
