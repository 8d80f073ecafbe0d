"""Decode image files to RGB arrays, and write PNG files."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.scene.image_files.decoding import MAX_PIXELS, check_stated_size, decode_picture
from pano_mvs.scene.image_files.header import PNG_START
from pano_mvs.scene.record import FilePart

_HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})


def decode_image(path: Path, data: bytes | None = None, *, max_pixels: int = MAX_PIXELS) -> NDArray[np.uint8]:
    """Return an image as (H, W, 3) uint8 RGB. 16-bit images are scaled; EXIF orientation and transparency are ignored.

    Only the first page of an image with several pages is read.

    Args:
        path: the file.
        data: its bytes, if they have been read already.
        max_pixels: the limit of pixels, which is compared with the header before memory is allocated.

    Raises:
        InputError: if the file cannot be read, is not an image, is truncated or damaged, is larger than the limit, or
            needs an extra that is not installed.
    """
    if data is None:
        data = FilePart(path).read_bytes()
    if data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS and b"avif" not in data[:64]:
        check_stated_size(data, path, max_pixels)
        return _decode_heic(data, path)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    if not data.startswith(PNG_START):  # whose 16 bits OpenCV reduces to 8 as we do, with half of the memory
        flags |= cv2.IMREAD_ANYDEPTH
    image = decode_picture(data, path, flags, max_pixels=max_pixels)
    if image is None and data[4:12] in (b"ftypavif", b"ftypavis"):
        raise InputError(
            f"{path}: this OpenCV ({cv2.__version__}) cannot read AVIF images, or the file is damaged. Install a "
            "newer opencv-python-headless, or convert it to JPEG"
        )
    if image is None:
        raise InputError(
            f"{path}: not an image that can be decoded ({len(data)} bytes). Remove it or convert it to "
            f"JPEG, or to PNG or TIFF of 8 or 16 bits"
        )
    del data  # frees memory
    if image.dtype == np.uint16:
        np.right_shift(image, 8, out=image)  # programs write 8 bits v in 16 as 257 v or 256 v; both give v
        return np.asarray(image[..., ::-1].astype(np.uint8, order="C"))
    if image.dtype != np.uint8:
        raise InputError(f"{path}: {image.dtype} images are not supported. Convert it to 8 or 16 bits")
    rgb: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)  # in place
    return rgb


def _decode_heic(data: bytes, path: Path) -> NDArray[np.uint8]:
    """Return a HEIC image as (H, W, 3) uint8 RGB; 10 or 12 bits are scaled."""
    try:
        pillow_heif = import_module("pillow_heif")
    except ImportError as error:
        raise InputError(
            f"{path}: HEIC images need an extra: pip install 'pano-mvs[heic]', or convert it to JPEG"
        ) from error
    try:
        picture = pillow_heif.open_heif(data, convert_hdr_to_8bit=True)
        image = np.array(picture, copy=True)  # a view may not outlive the image
    except (ValueError, EOFError, OSError, RuntimeError, SyntaxError) as error:
        raise InputError(
            f"{path}: not a HEIC image that can be decoded ({error}). Copy it again, or convert it to JPEG"
        ) from error
    rgb = image[..., :3] if image.ndim == 3 and image.shape[-1] >= 3 else np.atleast_3d(image)[..., :1].repeat(3, -1)
    return np.ascontiguousarray(rgb, dtype=np.uint8)


def write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an image, (H, W) grey or (H, W, 3) RGB uint8, as PNG."""
    ordered = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    path.write_bytes(cv2.imencode(".png", ordered)[1].tobytes())
