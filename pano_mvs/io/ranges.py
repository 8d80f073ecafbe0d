"""Range maps, normals and confidences as files that other programs read.

Writers raise UsageError for arrays of another shape or type, readers InputError for files that cannot be read or have
another layout.
"""

from __future__ import annotations

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.text import shortened
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_file import decode_picture
from pano_mvs.scene.image_header import MAX_PIXELS

_DEFLATE = 8  # TIFF's code of zlib compression, which every reader supports
_MAX_STEP = 65535


def write_range_tiff(path: Path, range_map: NDArray[np.float32]) -> None:
    """Write a range map as a one-channel float32 TIFF; NaN stays NaN, and no precision is lost."""
    _require(range_map, np.float32, "a range map")
    path.write_bytes(_encoded(".tiff", range_map, [cv2.IMWRITE_TIFF_COMPRESSION, _DEFLATE]))


def read_range_tiff(path: Path) -> NDArray[np.float32]:
    """Return the range map (H, W) float32 in a TIFF file, NaN where invalid."""
    return np.asarray(_one_channel(path, np.float32, "a range map is a one-channel float32 TIFF"))


def write_range_png(path: Path, range_map: NDArray[np.float32], *, unit: float) -> int:
    """Write a range map as a 16-bit grey PNG in steps of `unit`; 0 is invalid.

    A range below half a step is written as one step, so that it stays valid; a range beyond 65535 steps as 0.

    Returns:
        The number of ranges beyond the last step.
    """
    _require(range_map, np.float32, "a range map")
    steps = np.maximum(np.rint(range_map / np.float64(unit)), 1)  # NaN stays NaN
    beyond = steps > _MAX_STEP
    steps[beyond] = np.nan
    path.write_bytes(_encoded(".png", np.nan_to_num(steps).astype(np.uint16), []))
    return int(beyond.sum())


def write_normals_tiff(path: Path, normals: NDArray[np.float32]) -> None:
    """Write normals (H, W, 3) as a float32 TIFF whose red, green and blue are x, y and z; NaN stays NaN."""
    path.write_bytes(_encoded(".tiff", _checked_normals(normals)[..., ::-1], [cv2.IMWRITE_TIFF_COMPRESSION, _DEFLATE]))


def write_normals_png(path: Path, normals: NDArray[np.float32]) -> None:
    """Write normals (H, W, 3) as a 16-bit PNG: −1 to 1 of x, y, z as steps 1 to 65535 of red, green, blue."""
    steps = 1 + np.rint((np.clip(_checked_normals(normals), -1, 1) + 1) / 2 * (_MAX_STEP - 1))
    path.write_bytes(_encoded(".png", np.nan_to_num(steps).astype(np.uint16)[..., ::-1], []))


def read_normals(path: Path) -> NDArray[np.float32]:
    """Return the normals (H, W, 3) float32 of `write_normals_tiff` or `write_normals_png`, NaN where unknown."""
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
    """Write confidences (H, W) uint8 as an 8-bit grey PNG, 0 = invalid."""
    _require(confidence, np.uint8, "a confidence map")
    path.write_bytes(_encoded(".png", confidence, []))


def read_confidence_png(path: Path) -> NDArray[np.uint8]:
    """Return the confidences (H, W) uint8 in a PNG file, 0 = invalid."""
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


# The exceptions that zipfile, its decompressors and the parser of .npy headers raise for damaged files.
DAMAGE = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, EOFError, RuntimeError, SyntaxError, OverflowError),
    *(MemoryError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error, lzma.LZMAError),
)
_RATIOS = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: 1032}  # largest ratio of decompression
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npy(path: Path) -> NDArray[Any]:
    """Return the array in a .npy file.

    Raises:
        InputError: if the file cannot be read, contains no array of numbers, or fewer bytes than its header states.
    """
    try:
        with path.open("rb") as stream:
            return _read_array(stream, path.stat().st_size)
    except DAMAGE as error:
        raise InputError(f"{path}: not a readable .npy file ({_reason(error)}). Write it again") from error


def read_npz(path: Path, key: str, *, what: str = "") -> NDArray[Any]:
    """Return the array under a key of an .npz file.

    Raises:
        InputError: if the file cannot be read, or has no complete array of numbers of that name.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            member = archive.getinfo(f"{key}.npy")
            max_bytes = member.compress_size * _RATIOS.get(member.compress_type, member.file_size)
            with archive.open(member) as stream:
                return _read_array(stream, min(member.file_size, max_bytes))
    except DAMAGE as error:
        raise InputError(
            f"{path}: {what or f'the array {key}'} cannot be read ({_reason(error)}). Copy the file again"
        ) from error


def keys_of_npz(path: Path) -> list[str]:
    """Return the names of the arrays in an .npz file, in order.

    Raises:
        InputError: if it is not a readable archive.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return sorted(name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy"))
    except DAMAGE as error:
        raise InputError(f"{path}: not a readable .npz file ({_reason(error)}). Copy it again") from error


def _read_array(stream: IO[bytes], size_bytes: int) -> NDArray[Any]:
    """Return the array in a stream of at most `size_bytes` bytes."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of the format is not supported")
    shape, is_fortran, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError("it contains Python objects, which are not allowed")
    if len(shape) > 4 or min(shape, default=0) < 0:
        raise ValueError(f"its header states the shape {shape}")
    count = math.prod(shape)
    if count * dtype.itemsize > size_bytes:
        raise ValueError(f"its header states {count * dtype.itemsize} bytes, but there are at most {size_bytes}")
    if count > MAX_PIXELS:
        raise ValueError(f"its {count} numbers are more than the limit of {MAX_PIXELS}")
    data = stream.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize:
        raise EOFError(f"it ends after {len(data)} of {count * dtype.itemsize} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if is_fortran else "C")


def _reason(error: BaseException) -> str:
    """Return an exception's shortened text, or its type without one."""
    return shortened(str(error), 300) or type(error).__name__  # numpy repeats whole headers
