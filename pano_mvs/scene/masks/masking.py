"""Read masks, resize them conservatively, and fill masked pixels of images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import Mask
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene.image_files.decoding import decode_picture
from pano_mvs.scene.masks.cropping import Crop
from pano_mvs.scene.record import FilePart

_JPEG_START = b"\xff\xd8"
_JPEG_THRESHOLD = 127  # compression turns black and white into greys
# Masked pixels take the mean colour of the smallest box with valid pixels, up to this radius.
_MAX_BOX_RADIUS = 64
_GREY_WITHOUT_VALID_PIXELS = 128


def decode_mask(path: Path, data: bytes | None = None) -> Mask:
    """Return a mask file as (H, W) bool, False where its value is 0: these pixels are ignored.

    The image is grey or colour (the brightest channel counts) with any depth, or has a palette (its colours count).
    Pixels that are transparent by an alpha channel are ignored too; if all colours are black, only alpha counts. In a
    JPEG, where black is not exactly 0, the threshold is half the brightness.

    Args:
        path: the file.
        data: its bytes, if they have been read already.

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
    threshold = _JPEG_THRESHOLD if data.startswith(_JPEG_START) else 0
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


def painted_over(picture: NDArray[np.uint8], valid: Mask) -> NDArray[np.uint8]:
    """Return a panorama, (H, W, C), whose masked pixels are filled with surrounding colours.

    Each masked pixel has the mean of the valid pixels in the smallest box around it that contains any, across the seam
    and the poles; far from valid pixels, the mean of all. The result does not depend on the masked content, and has no
    edges at the mask.
    """
    painted = picture.copy()
    shown = valid.astype(np.uint8)
    if not shown.any():
        painted[...] = _GREY_WITHOUT_VALID_PIXELS
        return painted
    margin = min(_MAX_BOX_RADIUS, picture.shape[0])
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
