"""Decode a picture file into an RGB array, or say why not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError

# What OpenCV prints of pictures that it cannot decode is said better by our own error.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

# The JPEG decoder fills what a truncated file lacks with grey and only warns; the end marker tells.
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


def decode_image(path: Path) -> NDArray[np.uint8]:
    """Return a picture as (H, W, 3) uint8 RGB; 16-bit pictures are scaled, EXIF orientation is ignored.

    Raises:
        InputError: if the file cannot be read, is no picture, or is truncated.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Check that it exists and may be read") from error
    if data[:2] == _JPEG_START and _JPEG_END not in data[-(1 << 16) :]:
        raise InputError(
            f"{path}: the JPEG ends early (truncated after {len(data)} bytes). Copy it again from the camera"
        )
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise InputError(f"{path}: not a picture that can be decoded ({len(data)} bytes). Remove it or convert it to "
                         f"JPEG or PNG")  # fmt: skip
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    elif image.dtype != np.uint8:
        raise InputError(f"{path}: {image.dtype} pictures are not supported. Convert it to 8 or 16 bits")
    rgb: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return rgb


def write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture, (H, W) grey or (H, W, 3) RGB uint8, as PNG."""
    ordered = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    path.write_bytes(cv2.imencode(".png", ordered)[1].tobytes())
