"""Decode the bytes of a picture file within limits, and find out from the decoder itself whether they are damaged."""

from __future__ import annotations

import os
import re
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.scene.image_files.header import PNG_START, TIFF_STARTS, Size, stated_size
from pano_mvs.scene.image_files.jpeg import JPEG_START, is_cut_short

MAX_PIXELS = 512_000_000
"""The pixels of a picture that is decoded, unless a setting says otherwise."""

MASK_BYTES_PER_PIXEL = 8
"""What a mask takes while it is read and brought to size: grey levels, flags, and counts of masked pixels."""

# Measured at their most, the file included: TIFF of 16 bits, uncompressed, and PNG of 16 bits; JPEG takes 6.
_TIFF_BYTES_PER_PIXEL, _BYTES_PER_PIXEL = 18, 8

# What OpenCV prints of pictures that it cannot decode is said better by our own errors.
_SILENT = 0
if hasattr(cv2, "setLogLevel"):  # OpenCV 4
    cv2.setLogLevel(_SILENT)
else:
    cv2.utils.logging.setLogLevel(_SILENT)

# A header is believed up to here whatever the size of the file; beyond it, a JPEG, PNG or TIFF has no more pixels in
# a byte: deflate, their best compression, makes 1032 bytes of one, and a bilevel picture has 8 pixels in each.
_BELIEVED_PIXELS = 64_000_000
_PIXELS_PER_BYTE = 10_000
_COMPRESSED_STARTS = (JPEG_START, PNG_START, *TIFF_STARTS)

_OPENCV_PIXELS, _OPENCV_SIDE = 1 << 30, 1 << 20  # CV_IO_MAX_IMAGE_PIXELS, _WIDTH and _HEIGHT
_OPENCV_NO_MEMORY, _OPENCV_ASSERTION = -4, -215

# libjpeg's warnings about the data. Bytes too many in front of a marker other than a restart marker lose nothing:
# some cameras pad what they write.
_JPEG_WARNING = re.compile(r"(?:Corrupt JPEG data|Premature end of JPEG file|Inconsistent progression sequence).*")
_HARMLESS = re.compile(r".*extraneous bytes before marker 0x(?!d[0-7])..$")
_STDERR = 2
_turned = threading.Lock()


def decoding_bytes_per_pixel(path: Path) -> int:
    """Return the memory in bytes that decoding takes for each pixel of a picture file at most, the file included."""
    return _TIFF_BYTES_PER_PIXEL if path.suffix.lower() in {".tif", ".tiff"} else _BYTES_PER_PIXEL


def decode_picture(data: bytes, path: Path, flags: int, *, max_pixels: int = MAX_PIXELS) -> NDArray[np.generic] | None:
    """Return a picture as OpenCV decodes it, BGR; None if the bytes are no picture that it knows.

    Args:
        data: the file's bytes.
        path: of the file, for messages.
        flags: `cv2.IMREAD_…`.
        max_pixels: larger pictures are refused by their header, before they take memory.

    Raises:
        InputError: if the picture has more pixels than that, or than OpenCV or the memory can take, or if the header
            states more than the file can hold, or if a JPEG is cut short or damaged.
    """
    size = check_stated_size(data, path, max_pixels)
    if data.startswith(JPEG_START) and is_cut_short(data):
        raise InputError(
            f"{path}: the JPEG ends early (truncated after {len(data)} bytes). Copy it again from the camera"
        )
    if not data:
        return None
    try:
        image, warning = _decoded(data, flags)
    except (cv2.error, MemoryError) as error:
        raise InputError(f"{path}: {_why_not(error, size)}") from error
    if warning:
        raise InputError(
            f"{path}: the JPEG is damaged or its data end early: a part of the picture is missing "
            f"(decoder: {warning}). Copy it again from the camera"
        )
    return image


def check_stated_size(data: bytes, path: Path, max_pixels: int = MAX_PIXELS) -> Size | None:
    """Return the (height, width) that a picture's header states, if it states one that can be read and believed.

    Raises:
        InputError: if that is more than the limit, or than the file can hold.
    """
    size = stated_size(data)
    if size is None:
        return None
    height, width = size
    pixels = height * width
    what = f"{path}: its header states {width}×{height} px ({pixels / 1e6:.0f} megapixels)"
    if pixels > max_pixels:
        raise InputError(
            f"{what}, more than the limit of {max_pixels / 1e6:.0f}. Scale it down; for panoramas, the "
            "source's setting max_megapixels raises the limit"
        )
    if data.startswith(_COMPRESSED_STARTS) and pixels > max(_BELIEVED_PIXELS, _PIXELS_PER_BYTE * len(data)):
        raise InputError(
            f"{what}, but a file of {len(data)} bytes cannot hold them: it is damaged or cut short. Copy "
            "it again, or write it anew"
        )
    return size


def _decoded(data: bytes, flags: int) -> tuple[NDArray[np.generic] | None, str]:
    """Return the picture or None, and what libjpeg says of damaged data: it fills in what is missing."""
    array = np.frombuffer(data, np.uint8)
    if not data.startswith(JPEG_START):
        return cv2.imdecode(array, flags), ""
    said: list[str] = []
    with _warnings_of_libjpeg(said):
        image = cv2.imdecode(array, flags)
    return image, next((line for line in said if not _HARMLESS.fullmatch(line)), "")


@contextmanager
def _warnings_of_libjpeg(said: list[str]) -> Iterator[None]:
    """Collect what libjpeg warns of inside: it prints it to the error stream of the process and tells nobody else.

    That stream leads into a file meanwhile; what others wrote to it is passed on. Where it cannot be turned, nothing is
    collected.
    """
    with _turned, ExitStack() as stack:
        try:
            kept = os.dup(_STDERR)
            stack.callback(os.close, kept)
            caught = stack.enter_context(_file_in_memory())
            os.dup2(caught.fileno(), _STDERR)
        except OSError:
            yield
            return
        try:
            yield
        finally:
            os.dup2(kept, _STDERR)
        caught.seek(0)
        for line in caught.read().splitlines(keepends=True):
            text = line.decode(errors="replace").strip()
            if _JPEG_WARNING.fullmatch(text):
                said.append(text)
            else:
                with suppress(OSError):
                    os.write(_STDERR, line)


def _file_in_memory() -> BinaryIO:
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("libjpeg"), "w+b", 0)
    return tempfile.TemporaryFile(buffering=0)


def _why_not(error: Exception, size: Size | None) -> str:
    """Return what the user should know of a picture that OpenCV refused."""
    height, width = size or (0, 0)
    of = f" of {width}×{height} px ({width * height / 1e6:.0f} megapixels)" if size else ""
    code = error.code if isinstance(error, cv2.error) else _OPENCV_NO_MEMORY
    if code == _OPENCV_ASSERTION and (height * width > _OPENCV_PIXELS or max(height, width) > _OPENCV_SIDE):
        return (
            f"a picture{of} is more than OpenCV decodes, {_OPENCV_PIXELS / 1e6:.0f} megapixels and "
            f"{_OPENCV_SIDE} px on a side. Scale it down"
        )
    if code == _OPENCV_NO_MEMORY:
        return f"there is not enough memory to decode a picture{of}. Close other programs, or scale it down"
    states = f" (its header states {width}×{height} px)" if size else ""
    return f"not a picture that can be decoded{states}. Copy it again"
