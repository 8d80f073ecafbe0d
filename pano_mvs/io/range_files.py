"""Range maps and confidences as picture files that other programs read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError

_DEFLATE = 8  # TIFF's code for the compression that every reader has (zlib)


def write_range_tiff(path: Path, range_map: NDArray[np.float32]) -> None:
    """Write a range map as a one-channel float32 TIFF; NaN stays NaN, no digit is lost.

    Args:
        path: the file to write.
        range_map: (H, W) float32.

    Raises:
        UsageError: if the array is another.
    """
    if range_map.dtype != np.float32 or range_map.ndim != 2:
        raise UsageError(f"a range map is (H, W) float32, got {range_map.shape} {range_map.dtype}")
    path.write_bytes(_encoded(".tiff", range_map, [cv2.IMWRITE_TIFF_COMPRESSION, _DEFLATE]))


def read_range_tiff(path: Path) -> NDArray[np.float32]:
    """Return the range map (H, W) float32 in a TIFF file, NaN where invalid.

    Raises:
        InputError: if the file cannot be read or is no one-channel float32 picture.
    """
    array = _decoded(path)
    if array is None or array.dtype != np.float32 or array.ndim != 2:
        what = "no picture" if array is None else f"{array.shape} {array.dtype}"
        raise InputError(f"{path}: a range map is a one-channel float32 TIFF, this is {what}. Write it again")
    return np.asarray(array)


def write_confidence_png(path: Path, confidence: NDArray[np.uint8]) -> None:
    """Write confidences (H, W) uint8 as an 8-bit grey PNG, 0 = invalid.

    Raises:
        UsageError: if the array is another.
    """
    if confidence.dtype != np.uint8 or confidence.ndim != 2:
        raise UsageError(f"a confidence map is (H, W) uint8, got {confidence.shape} {confidence.dtype}")
    path.write_bytes(_encoded(".png", confidence, []))


def read_confidence_png(path: Path) -> NDArray[np.uint8]:
    """Return the confidences (H, W) uint8 in a PNG file, 0 = invalid.

    Raises:
        InputError: if the file cannot be read or is no 8-bit grey picture.
    """
    array = _decoded(path)
    if array is None or array.dtype != np.uint8 or array.ndim != 2:
        what = "no picture" if array is None else f"{array.shape} {array.dtype}"
        raise InputError(f"{path}: a confidence map is an 8-bit grey PNG, this is {what}. Write it again")
    return np.asarray(array)


def _decoded(path: Path) -> NDArray[np.generic] | None:
    """Return the picture in a file as it is stored; None if it is no picture."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Check that it exists and may be read") from error
    if not data:
        return None
    array: NDArray[np.generic] | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return array


def _encoded(suffix: str, array: NDArray[np.generic], options: list[int]) -> bytes:
    encoded, data = cv2.imencode(suffix, array, options)
    assert encoded
    return bytes(data)
