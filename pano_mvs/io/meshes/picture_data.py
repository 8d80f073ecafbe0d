"""Textures as the bytes of a JPEG or PNG file."""

from __future__ import annotations

from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError

TextureFormat = Literal["jpeg", "png"]

SUFFIXES: Final[dict[TextureFormat, str]] = {"jpeg": ".jpg", "png": ".png"}
MIME_TYPES: Final[dict[TextureFormat, str]] = {"jpeg": "image/jpeg", "png": "image/png"}


def encoded_texture(texture: NDArray[np.uint8], form: TextureFormat, *, quality: int) -> bytes:
    """Return a texture (H, W, 3) RGB as the bytes of an image file.

    Args:
        texture: (H, W, 3) uint8 RGB.
        form: file format.
        quality: quality of a JPEG, 1 to 100; its colours keep their full resolution, because charts have sharp edges.

    Raises:
        UsageError: if OpenCV cannot write it, for example because it is larger than 65535 pixels.
    """
    options = [cv2.IMWRITE_PNG_COMPRESSION, 6]
    if form == "jpeg":
        options = [
            *(cv2.IMWRITE_JPEG_QUALITY, quality),
            *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
        ]
    done, data = cv2.imencode(SUFFIXES[form], cv2.cvtColor(texture, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise UsageError(f"a texture of {texture.shape[1]}×{texture.shape[0]} px cannot be written as {form}")
    return data.tobytes()
