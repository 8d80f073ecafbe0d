"""Range maps and confidences as picture files that other programs read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.scene.image_files.decoding import decode_picture

_DEFLATE = 8  # TIFF's code for the compression that every reader has (zlib)
_LARGEST_STEP = 65535


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


def write_range_png(path: Path, range_map: NDArray[np.float32], *, unit: float) -> int:
    """Write a range map as a 16-bit grey PNG in steps of `unit`; 0 is invalid.

    A range below half a step is written as one step, so that it stays valid; one beyond 65535 steps as 0.

    Args:
        path: the file to write.
        range_map: (H, W) float32, scene units, NaN invalid.
        unit: scene units of one step.

    Returns:
        The number of ranges that lie beyond the last step.

    Raises:
        UsageError: if the array is another.
    """
    if range_map.dtype != np.float32 or range_map.ndim != 2:
        raise UsageError(f"a range map is (H, W) float32, got {range_map.shape} {range_map.dtype}")
    steps = np.maximum(np.rint(range_map / np.float64(unit)), 1)  # NaN stays NaN
    beyond = steps > _LARGEST_STEP
    steps[beyond] = np.nan
    path.write_bytes(_encoded(".png", np.nan_to_num(steps).astype(np.uint16), []))
    return int(beyond.sum())


def read_range_png(path: Path, *, unit: float) -> NDArray[np.float32]:
    """Return the range map (H, W) float32 in a 16-bit PNG file, NaN where it has 0.

    Args:
        path: the file.
        unit: scene units of one step.

    Raises:
        InputError: if the file cannot be read or is no 16-bit grey picture.
    """
    array = _decoded(path)
    if array is None or array.dtype != np.uint16 or array.ndim != 2:
        what = "no picture" if array is None else f"{array.shape} {array.dtype}"
        raise InputError(f"{path}: a range map in steps is a 16-bit grey PNG, this is {what}. Write it again")
    steps = np.asarray(array, np.float64)
    return np.where(steps > 0, steps * unit, np.nan).astype(np.float32)


def write_normals_tiff(path: Path, normals: NDArray[np.float32]) -> None:
    """Write normals (H, W, 3) as a float32 TIFF whose red, green and blue are x, y and z; NaN stays NaN.

    Raises:
        UsageError: if the array is another.
    """
    path.write_bytes(_encoded(".tiff", _checked_normals(normals)[..., ::-1], [cv2.IMWRITE_TIFF_COMPRESSION, _DEFLATE]))


def write_normals_png(path: Path, normals: NDArray[np.float32]) -> None:
    """Write normals (H, W, 3) as a 16-bit PNG: x, y, z from −1 to 1 as red, green, blue from 1 to 65535; 0 0 0 unknown.

    Raises:
        UsageError: if the array is another.
    """
    steps = 1 + np.rint((np.clip(_checked_normals(normals), -1, 1) + 1) / 2 * (_LARGEST_STEP - 1))
    path.write_bytes(_encoded(".png", np.nan_to_num(steps).astype(np.uint16)[..., ::-1], []))


def read_normals(path: Path) -> NDArray[np.float32]:
    """Return the normals (H, W, 3) float32 in a file of `write_normals_tiff` or `write_normals_png`, NaN where unknown.

    Raises:
        InputError: if the file cannot be read or is no such picture.
    """
    array = _decoded(path)
    if array is None or array.dtype not in (np.float32, np.uint16) or array.ndim != 3:
        what = "no picture" if array is None else f"{array.shape} {array.dtype}"
        raise InputError(f"{path}: normals are a float32 TIFF or a 16-bit PNG of three channels, this is {what}. "
                         "Write it again")  # fmt: skip
    normals = array[..., ::-1].astype(np.float32)
    if array.dtype == np.uint16:
        known = (normals > 0).any(axis=-1, keepdims=True)
        normals = np.where(known, (normals - 1) / (_LARGEST_STEP - 1) * 2 - 1, np.nan).astype(np.float32)
    return normals


def _checked_normals(normals: NDArray[np.float32]) -> NDArray[np.float32]:
    if normals.dtype != np.float32 or normals.ndim != 3 or normals.shape[2] != 3:
        raise UsageError(f"normals are (H, W, 3) float32, got {normals.shape} {normals.dtype}")
    return normals


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
    return decode_picture(data, path, cv2.IMREAD_UNCHANGED)


def _encoded(suffix: str, array: NDArray[np.generic], options: list[int]) -> bytes:
    encoded, data = cv2.imencode(suffix, np.ascontiguousarray(array), options)
    assert encoded
    return bytes(data)
