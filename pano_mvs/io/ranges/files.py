"""Range maps, normals and confidences as image files that other programs read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_files.decoding import decode_picture

_DEFLATE = 8  # TIFF's code of zlib compression, which every reader supports
_MAX_STEP = 65535


def write_range_tiff(path: Path, range_map: NDArray[np.float32]) -> None:
    """Write a range map as a one-channel float32 TIFF; NaN stays NaN, and no precision is lost.

    Args:
        path: the file to write.
        range_map: (H, W) float32.

    Raises:
        UsageError: if the array has another shape or type.
    """
    _require(range_map, np.float32, "a range map")
    path.write_bytes(_encoded(".tiff", range_map, [cv2.IMWRITE_TIFF_COMPRESSION, _DEFLATE]))


def read_range_tiff(path: Path) -> NDArray[np.float32]:
    """Return the range map (H, W) float32 in a TIFF file, NaN where invalid.

    Raises:
        InputError: if the file cannot be read or is not a one-channel float32 image.
    """
    return np.asarray(_one_channel(path, np.float32, "a range map is a one-channel float32 TIFF"))


def write_range_png(path: Path, range_map: NDArray[np.float32], *, unit: float) -> int:
    """Write a range map as a 16-bit grey PNG in steps of `unit`; 0 is invalid.

    A range below half a step is written as one step, so that it stays valid; a range beyond 65535 steps as 0.

    Args:
        path: the file to write.
        range_map: (H, W) float32, scene units, NaN invalid.
        unit: scene units of one step.

    Returns:
        The number of ranges beyond the last step.

    Raises:
        UsageError: if the array has another shape or type.
    """
    _require(range_map, np.float32, "a range map")
    steps = np.maximum(np.rint(range_map / np.float64(unit)), 1)  # NaN stays NaN
    beyond = steps > _MAX_STEP
    steps[beyond] = np.nan
    path.write_bytes(_encoded(".png", np.nan_to_num(steps).astype(np.uint16), []))
    return int(beyond.sum())


def read_range_png(path: Path, *, unit: float) -> NDArray[np.float32]:
    """Return the range map (H, W) float32 in a 16-bit PNG file, NaN where it has 0.

    Args:
        path: the file.
        unit: scene units of one step.

    Raises:
        InputError: if the file cannot be read or is not a 16-bit grey image.
    """
    steps = np.asarray(_one_channel(path, np.uint16, "a range map in steps is a 16-bit grey PNG"), np.float64)
    return np.where(steps > 0, steps * unit, np.nan).astype(np.float32)


def write_normals_tiff(path: Path, normals: NDArray[np.float32]) -> None:
    """Write normals (H, W, 3) as a float32 TIFF whose red, green and blue are x, y and z; NaN stays NaN.

    Raises:
        UsageError: if the array has another shape or type.
    """
    path.write_bytes(_encoded(".tiff", _checked_normals(normals)[..., ::-1], [cv2.IMWRITE_TIFF_COMPRESSION, _DEFLATE]))


def write_normals_png(path: Path, normals: NDArray[np.float32]) -> None:
    """Write normals (H, W, 3) as a 16-bit PNG: x, y, z from −1 to 1 as red, green, blue from 1 to 65535; 0 0 0 unknown.

    Raises:
        UsageError: if the array has another shape or type.
    """
    steps = 1 + np.rint((np.clip(_checked_normals(normals), -1, 1) + 1) / 2 * (_MAX_STEP - 1))
    path.write_bytes(_encoded(".png", np.nan_to_num(steps).astype(np.uint16)[..., ::-1], []))


def read_normals(path: Path) -> NDArray[np.float32]:
    """Return the normals (H, W, 3) float32 in a file of `write_normals_tiff` or `write_normals_png`, NaN where unknown.

    Raises:
        InputError: if the file cannot be read or has another layout.
    """
    array = _decoded(path)
    if array is None or array.dtype not in (np.float32, np.uint16) or array.ndim != 3:
        what = "not an image" if array is None else f"{array.shape} {array.dtype}"
        raise InputError(
            f"{path}: normals are a float32 TIFF or a 16-bit PNG of three channels, this is {what}. Write it again"
        )
    normals = array[..., ::-1].astype(np.float32)
    if array.dtype == np.uint16:
        known = (normals > 0).any(axis=-1, keepdims=True)
        normals = np.where(known, (normals - 1) / (_MAX_STEP - 1) * 2 - 1, np.nan).astype(np.float32)
    return normals


def _checked_normals(normals: NDArray[np.float32]) -> NDArray[np.float32]:
    if normals.dtype != np.float32 or normals.ndim != 3 or normals.shape[2] != 3:
        raise UsageError(f"normals are (H, W, 3) float32, got {normals.shape} {normals.dtype}")
    return normals


def write_confidence_png(path: Path, confidence: NDArray[np.uint8]) -> None:
    """Write confidences (H, W) uint8 as an 8-bit grey PNG, 0 = invalid.

    Raises:
        UsageError: if the array has another shape or type.
    """
    _require(confidence, np.uint8, "a confidence map")
    path.write_bytes(_encoded(".png", confidence, []))


def read_confidence_png(path: Path) -> NDArray[np.uint8]:
    """Return the confidences (H, W) uint8 in a PNG file, 0 = invalid.

    Raises:
        InputError: if the file cannot be read or is not an 8-bit grey image.
    """
    return np.asarray(_one_channel(path, np.uint8, "a confidence map is an 8-bit grey PNG"))


def _require(array: NDArray[np.generic], dtype: type[np.generic], what: str) -> None:
    """Raise UsageError unless an array is (H, W) of a type."""
    if array.dtype != dtype or array.ndim != 2:
        raise UsageError(f"{what} is (H, W) {np.dtype(dtype).name}, got {array.shape} {array.dtype}")


def _one_channel(path: Path, dtype: type[np.generic], rule: str) -> NDArray[np.generic]:
    """Return the image (H, W) in a file, or raise InputError, which quotes the rule, if it has another layout."""
    array = _decoded(path)
    if array is None or array.dtype != dtype or array.ndim != 2:
        what = "not an image" if array is None else f"{array.shape} {array.dtype}"
        raise InputError(f"{path}: {rule}, this is {what}. Write it again")
    return array


def _decoded(path: Path) -> NDArray[np.generic] | None:
    """Return the image in a file as it is stored, or None if it is not an image."""
    return decode_picture(FilePart(path).read_bytes(), path, cv2.IMREAD_UNCHANGED)


def _encoded(suffix: str, array: NDArray[np.generic], options: list[int]) -> bytes:
    encoded, data = cv2.imencode(suffix, np.ascontiguousarray(array), options)
    assert encoded
    return bytes(data)
