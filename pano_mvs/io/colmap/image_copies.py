"""Images and masks of a COLMAP model at the size of its cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.image_files.image_file import write_png

_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
_WRITABLE = (".bmp", ".tif", ".tiff", ".webp")


def write_picture(path: Path, picture: NDArray[np.uint8], size_hw: tuple[int, int] | None = None) -> None:
    """Write an image (H, W, 3) uint8 RGB in the format of the path's suffix; other formats become JPEG (quality 95).

    Args:
        path: the file.
        picture: the image.
        size_hw: (height, width) to which the image is resized; by default its own size.
    """
    if size_hw is not None and picture.shape[:2] != size_hw:
        enlarged = size_hw[1] > picture.shape[1]
        way = cv2.INTER_CUBIC if enlarged else cv2.INTER_AREA
        picture = np.asarray(cv2.resize(picture, size_hw[::-1], interpolation=way), np.uint8)
    suffix = path.suffix.lower()
    if suffix == ".png":
        write_png(path, picture)
        return
    kind, options = (suffix, []) if suffix in _WRITABLE else (".jpg", _JPEG)
    path.write_bytes(cv2.imencode(kind, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)[1].tobytes())


def resized_mask(mask: NDArray[np.bool_], size_hw: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask (H, W) resized with nearest-neighbour sampling at the centres of the new pixels."""
    rows, columns = (
        np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.intp), old - 1)
        for new, old in zip(size_hw, mask.shape, strict=True)
    )
    return np.asarray(mask[rows[:, None], columns])
