"""Read .npy and .npz files of any program, after checking their headers against the size of the file."""

from __future__ import annotations

import lzma
import math
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.text import shortened
from pano_mvs.scene.image_files.decoding import MAX_PIXELS

# The exceptions that zipfile, its decompressors and the parser of .npy headers raise for damaged files.
DAMAGE = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, EOFError, RuntimeError, SyntaxError, OverflowError),
    *(MemoryError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error, lzma.LZMAError),
)
_MAX_DIMENSIONS = 4
_MAX_REASON = 300  # characters; numpy repeats whole headers
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

    Args:
        path: the file.
        key: the array's name.
        what: description of the array in error messages; its name by default.

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
    """Return the array in a stream of at most `size_bytes` bytes.

    Raises:
        ValueError: if it contains objects, or is larger than the stream or than the limit of images.
        Exception: one of `DAMAGE` if the stream is damaged.
    """
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of the format is not supported")
    shape, is_fortran, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError("it contains Python objects, which are not allowed")
    if len(shape) > _MAX_DIMENSIONS or min(shape, default=0) < 0:
        raise ValueError(f"its header states the shape {shape}")
    count = math.prod(shape)
    if count * dtype.itemsize > size_bytes:
        raise ValueError(f"its header states {count * dtype.itemsize} bytes, but there are at most {size_bytes}")
    if count > MAX_PIXELS:
        raise ValueError(f"its {count} numbers are more than the limit of {MAX_PIXELS}")
    values = np.frombuffer(_read_exactly(stream, count * dtype.itemsize), dtype)
    return values.reshape(shape, order="F" if is_fortran else "C")


def _read_exactly(stream: IO[bytes], size_bytes: int) -> bytes:
    data = stream.read(size_bytes)
    if len(data) < size_bytes:
        raise EOFError(f"it ends after {len(data)} of {size_bytes} bytes")
    return data


def _reason(error: BaseException) -> str:
    """Return an exception's shortened text, or its type without one."""
    return shortened(str(error), _MAX_REASON) or type(error).__name__
