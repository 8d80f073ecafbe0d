"""The kind of an image file, and the size that its header states.

JPEG: ITU-T T.81, the start of frame. PNG: the chunk IHDR. WebP: the RIFF chunks VP8, VP8L and VP8X. TIFF: the first
directory. HEIC and AVIF: the boxes `ispe` of ISO/IEC 23008-12, of which the largest is that of the whole image.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal, TypeAlias

from pano_mvs.scene.image_files.jpeg import JPEG_FRAMES, JPEG_START, jpeg_segments
from pano_mvs.scene.image_files.tiff_directory import open_tiff

Size: TypeAlias = "tuple[int, int]"
ImageKind: TypeAlias = Literal["jpeg", "png", "webp", "tiff", "heif"]
"""`heif` includes AVIF."""

PNG_START = b"\x89PNG\r\n\x1a\n"
TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_WIDTH, _HEIGHT = 256, 257
_FIRST_BYTES = 1 << 16
_HEIF_BYTES = 1 << 20
_DAMAGE = (struct.error, IndexError, OverflowError)


def image_kind(data: bytes) -> ImageKind | None:
    """Return the kind of an image file by its first bytes, or None for any other file."""
    if data.startswith(JPEG_START):
        return "jpeg"
    if data.startswith(PNG_START):
        return "png"
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return "webp"
    if data.startswith(TIFF_STARTS):
        return "tiff"
    return "heif" if data[4:8] == b"ftyp" else None


def stated_size(data: bytes) -> Size | None:
    """Return the (height, width) that an image file's header states, or None if it cannot be read.

    Args:
        data: the file's bytes, or as many as contain the header.
    """
    kind = image_kind(data)
    try:
        return None if kind is None else _READERS[kind](data)
    except _DAMAGE:
        return None


def stated_size_of_file(path: Path) -> Size | None:
    """Return the `stated_size` of a file without reading all of it if possible; None if the file cannot be read."""
    try:
        with path.open("rb") as stream:
            data = stream.read(_FIRST_BYTES)
            size = stated_size(data)
            return size if size is not None or len(data) < _FIRST_BYTES else stated_size(data + stream.read())
    except OSError:
        return None


def riff_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the chunks of a RIFF file, such as a WebP: kind, start and end of each."""
    offset = 12
    while offset + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, offset)
        yield kind, offset + 8, min(offset + 8 + length, len(data))
        offset += 8 + length + length % 2


def _jpeg_size(data: bytes) -> Size | None:
    for marker, start, _ in jpeg_segments(data):
        if marker in JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, start + 1)
            return _positive(height, width)
    return None


def _png_size(data: bytes) -> Size | None:
    _, kind, width, height = struct.unpack_from(">I4sII", data, len(PNG_START))
    return _positive(height, width) if kind == b"IHDR" else None


def _webp_size(data: bytes) -> Size | None:
    sizes = (_WEBP_SIZES[kind](data, start) for kind, start, _ in riff_chunks(data) if kind in _WEBP_SIZES)
    return next((size for size in sizes if size[0] and size[1]), None)


def _canvas(data: bytes, start: int) -> Size:
    low_width, high_width, low_height, high_height = struct.unpack_from("<HBHB", data, start + 4)
    return (high_height << 16 | low_height) + 1, (high_width << 16 | low_width) + 1


def _lossy(data: bytes, start: int) -> Size:
    width, height = struct.unpack_from("<HH", data, start + 6)
    return height & 0x3FFF, width & 0x3FFF


def _lossless(data: bytes, start: int) -> Size:
    (bits,) = struct.unpack_from("<I", data, start + 1)
    return (bits >> 14 & 0x3FFF) + 1, (bits & 0x3FFF) + 1


_WEBP_SIZES: dict[bytes, Callable[[bytes, int], Size]] = {b"VP8X": _canvas, b"VP8 ": _lossy, b"VP8L": _lossless}


def _tiff_size(data: bytes) -> Size | None:
    tiff = open_tiff(data)
    if tiff is None:
        return None
    entries = tiff.directory(tiff.first)
    return _positive(tiff.integer(entries.get(_HEIGHT)) or 0, tiff.integer(entries.get(_WIDTH)) or 0)


def _heif_size(data: bytes) -> Size | None:
    """Return the largest size in a HEIC or AVIF file, which states those of tiles and thumbnails too."""
    sizes: list[Size] = []
    at = data.find(b"ispe", 0, _HEIF_BYTES)
    while at >= 0:
        width, height = struct.unpack_from(">II", data, at + 8)
        sizes.append((height, width))
        at = data.find(b"ispe", at + 4, _HEIF_BYTES)
    return _positive(*max(sizes, key=lambda size: size[0] * size[1])) if sizes else None


def _positive(height: int, width: int) -> Size | None:
    return (height, width) if height and width else None


_READERS: Mapping[ImageKind, Callable[[bytes], Size | None]] = {
    "jpeg": _jpeg_size,
    "png": _png_size,
    "webp": _webp_size,
    "tiff": _tiff_size,
    "heif": _heif_size,
}
