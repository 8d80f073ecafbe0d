"""The kind of an image file, and the size that its header states.

JPEG: ITU-T T.81, the start of frame. PNG: the chunk IHDR. WebP: the RIFF chunks VP8, VP8L and VP8X. TIFF: the first
directory. HEIC and AVIF: the boxes `ispe` of ISO/IEC 23008-12, of which the largest is that of the whole image.
Radiance HDR: its line of the resolution. EXR: the attributes of its first part.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

Size: TypeAlias = "tuple[int, int]"
Data: TypeAlias = bytes | mmap  # of an image file, in memory or mapped
ImageKind: TypeAlias = Literal["jpeg", "png", "webp", "tiff", "heif", "hdr", "exr"]  # `heif` includes AVIF
MAX_PIXELS = 512_000_000  # default limit of pixels of an image that is decoded
PNG_START = b"\x89PNG\r\n\x1a\n"
TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
HDR_STARTS, EXR_START = (b"#?RADIANCE", b"#?RGBE"), b"v/1\x01"
_WIDTH, _HEIGHT = 256, 257
_COLORS, _SAMPLES, _EXTRA_SAMPLES, _SAMPLE_FORMAT = 262, 277, 338, 339
_CMYK, _FLOATS, _ALPHAS = 5, 3, (1, 2)  # values of these fields; alpha is premultiplied (1) or not (2)
_PNG_GREY = 0  # colour type
_FIRST_BYTES = 1 << 16
_HEIF_BYTES = 1 << 20
_DAMAGE = (struct.error, IndexError, OverflowError, KeyError, ValueError)


def image_kind(data: Data) -> ImageKind | None:
    """Return the kind of an image file by its first bytes, or None for any other file."""
    start = data[:16]
    if start.startswith(JPEG_START):
        return "jpeg"
    if start.startswith(PNG_START):
        return "png"
    if start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        return "webp"
    if start.startswith(TIFF_STARTS):
        return "tiff"
    if start.startswith(HDR_STARTS):
        return "hdr"
    if start.startswith(EXR_START):
        return "exr"
    return "heif" if start[4:8] == b"ftyp" else None


def stated_size(data: bytes) -> Size | None:
    """Return the (height, width) that an image file's header states, or None if it cannot be read."""
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


def riff_chunks(data: Data) -> Iterator[tuple[bytes, int, int]]:
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


def _hdr_size(data: bytes) -> Size | None:
    found = re.search(rb"\n\n-Y (\d{1,9}) \+X (\d{1,9})\n", data[:_FIRST_BYTES])  # OpenCV reads no other order
    return None if found is None else _positive(int(found[1]), int(found[2]))


def _exr_size(data: bytes) -> Size | None:
    _, (left, top, right, bottom) = exr_windows(data)
    return _positive(max(0, bottom - top + 1), max(0, right - left + 1))


def exr_windows(data: Data) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the part that an EXR file stores, and the whole picture: first column and row, last column and row.

    Raises:
        KeyError, struct.error, IndexError, ValueError: if it is damaged.
    """
    attributes = _exr_attributes(data)
    return struct.unpack("<4i", attributes[b"dataWindow"]), struct.unpack("<4i", attributes[b"displayWindow"])


def _exr_attributes(data: Data) -> dict[bytes, bytes]:
    """Return the attributes of the first part of an EXR file by name."""
    attributes: dict[bytes, bytes] = {}
    offset = 8
    while data[offset]:
        name, kind, _ = data[offset : offset + 512].split(b"\0", 2)
        offset += len(name) + len(kind) + 2
        (length,) = struct.unpack_from("<I", data, offset)
        attributes[name] = data[offset + 4 : offset + 4 + length]
        offset += 4 + length
    return attributes


def _exr_channels(data: Data) -> set[bytes]:
    """Return the names of the channels of the first part, each of which 17 bytes follow."""
    listed, names = _exr_attributes(data)[b"channels"], set[bytes]()
    while listed[:1] not in (b"", b"\0"):
        name, _, rest = listed.partition(b"\0")
        names.add(name)
        listed = rest[16:]
    return names


def _positive(height: int, width: int) -> Size | None:
    return (height, width) if height and width else None


_READERS: Mapping[ImageKind, Callable[[bytes], Size | None]] = {
    "jpeg": _jpeg_size,
    "png": _png_size,
    "webp": _webp_size,
    "tiff": _tiff_size,
    "heif": _heif_size,
    "hdr": _hdr_size,
    "exr": _exr_size,
}


def of_file(path: Path, question: Callable[[Data], bool]) -> bool:
    """Return the answer to one of the questions below for a file, of which little is read; False if it is not readable.

    The directory of a TIFF may be at its end.
    """
    try:
        with path.open("rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
            return question(data)
    except (OSError, ValueError):
        return False


def holds_floats(data: Data) -> bool:
    """Return whether the pixels of an image are floating-point numbers, whose range is open (HDR)."""
    kind = image_kind(data)
    return kind in ("hdr", "exr") or (kind == "tiff" and _tiff_fields(data).get(_SAMPLE_FORMAT) == _FLOATS)


def is_map(data: Data) -> bool:
    """Return whether an image is a map of a quantity, such as ranges: a TIFF of one float, an EXR without R, G, B."""
    if image_kind(data) == "tiff":
        return holds_floats(data) and _tiff_fields(data).get(_SAMPLES, 1) == 1
    try:
        return image_kind(data) == "exr" and not {b"R", b"G", b"B"} <= _exr_channels(data)
    except _DAMAGE:
        return False


def has_alpha(data: Data) -> bool:
    """Return whether a PNG, WebP or colour TIFF file states how opaque its pixels are; see `has_unread_alpha`."""
    try:
        match image_kind(data):
            case "png":
                return data[25] in (4, 6) or _transparency(data) > 0
            case "webp":
                kind, start, _ = next(riff_chunks(data))
                return bool(data[start if kind == b"VP8X" else start + 4] & 16) and kind != b"VP8 "
            case "tiff":
                fields = _tiff_fields(data)
                missing = _ALPHAS[1] if fields.get(_SAMPLES) == 4 else 0  # OpenCV writes RGBA without the field
                stated = fields.get(_EXTRA_SAMPLES, missing) in _ALPHAS
                return stated and fields.get(_COLORS) != _CMYK and fields.get(_SAMPLES) != 2
    except (StopIteration, *_DAMAGE):
        pass
    return False


def has_unread_alpha(data: Data) -> bool:
    """Return whether an image is a grey TIFF with an alpha channel, which OpenCV drops."""
    if image_kind(data) != "tiff":
        return False
    fields = _tiff_fields(data)
    return fields.get(_SAMPLES) == 2 and fields.get(_EXTRA_SAMPLES) in _ALPHAS


def transparent_grey(data: Data) -> int | None:
    """Return the level that a grey PNG without alpha channel states to be transparent, as OpenCV decodes it.

    OpenCV scales levels of 1, 2 and 4 bits to 8. None if there is no such level.
    """
    if image_kind(data) != "png" or data[25] != _PNG_GREY or (start := _transparency(data)) < 0:
        return None
    (level,) = struct.unpack_from(">H", data, start + 4)
    bits = data[24]
    most = (1 << bits) - 1
    return int(level) & most if bits >= 8 else (level & most) * 255 // most


def _transparency(data: Data) -> int:
    """Return where a PNG's chunk `tRNS` is, of a palette or of one colour; −1 if there is none before the pixels."""
    return data.find(b"tRNS", 0, data.find(b"IDAT"))


def _tiff_fields(data: Data) -> dict[int, int]:
    """Return the first number of each integer field of the first directory of a TIFF."""
    tiff = open_tiff(data)
    try:
        entries = {} if tiff is None else tiff.directory(tiff.first)
        return {tag: value for tag in entries if tiff and (value := tiff.integer(entries[tag])) is not None}
    except _DAMAGE:
        return {}


JPEG_START = b"\xff\xd8"
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Start-of-frame markers: C0–CF without the tables DHT (C4), JPG (C8) and DAC (CC)."""
_SCAN, _END = 0xDA, b"\xff\xd9"
_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length: TEM, RST0 to RST7, SOI


class Segment(NamedTuple):
    """One segment: the second byte of its marker, and the start and end of its contents."""

    marker: int
    start: int
    end: int


def jpeg_segments(data: bytes) -> Iterator[Segment]:
    """Yield the segments of a JPEG up to and including the header of its first scan.

    A damaged file yields the segments before the damage; other files yield nothing.
    """
    if not data.startswith(JPEG_START):
        return
    offset = len(JPEG_START)
    while offset + 4 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if marker == 0xFF:  # a fill byte
            offset += 1
            continue
        if marker in _ALONE:
            offset += 2
            continue
        length = int.from_bytes(data[offset + 2 : offset + 4], "big")
        end = offset + 2 + length
        if length < 2 or end > len(data):
            return
        yield Segment(marker, offset + 4, end)
        if marker == _SCAN:
            return
        offset = end


def is_cut_short(data: bytes) -> bool:
    """Return whether a JPEG ends before its end marker. Decoders fill the missing part with grey without an error.

    The marker cannot occur within a scan. Cameras may append data behind it (videos, previews), which is ignored.
    """
    scan = next((segment for segment in jpeg_segments(data) if segment.marker == _SCAN), None)
    return scan is None or data.find(_END, scan.end) < 0


_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_INTEGERS = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}


class Entry(NamedTuple):
    """A field of a directory: its type, and the start and end of its bytes."""

    kind: int
    start: int
    end: int


@dataclass(frozen=True)
class Tiff:
    """A TIFF in memory."""

    data: Data
    order: str  # "<" or ">"
    first: int  # offset of its first directory
    is_big: bool  # whether it is a BigTIFF

    def directory(self, offset: int) -> Mapping[int, Entry]:
        """Return the entries of the directory at an offset by tag, without those that point outside of the data."""
        head, row, wide = ("Q", "HHQ", 8) if self.is_big else ("H", "HHI", 4)
        (count,) = struct.unpack_from(self.order + head, self.data, offset)
        entries: dict[int, Entry] = {}
        for idx in range(min(count, 1000)):
            at = offset + struct.calcsize("=" + head) + idx * (4 + 2 * wide)
            tag, kind, length = struct.unpack_from(self.order + row, self.data, at)
            size, start = _SIZES.get(kind, 1) * length, at + 4 + wide
            if size > wide:
                (start,) = struct.unpack_from(self.order + ("Q" if self.is_big else "I"), self.data, start)
            if start + size <= len(self.data):
                entries.setdefault(tag, Entry(kind, start, start + size))
        return entries

    def raw(self, entry: Entry) -> bytes:
        """Return the bytes of a field."""
        return self.data[entry.start : entry.end]

    def integer(self, entry: Entry | None) -> int | None:
        """Return the first number of an integer field, or None if it is not one."""
        if entry is None or entry.kind not in _INTEGERS or entry.end == entry.start:
            return None
        (value,) = struct.unpack_from(self.order + _INTEGERS[entry.kind], self.data, entry.start)
        return int(value)

    def rationals(self, entry: Entry, count: int) -> tuple[float, ...] | None:
        """Return the first `count` numbers of a field of fractions, or None if it has not as many."""
        if entry.kind != 5 or entry.end - entry.start < 8 * count:
            return None
        numbers = struct.unpack_from(f"{self.order}{2 * count}I", self.data, entry.start)
        return tuple(above / below for above, below in zip(numbers[::2], numbers[1::2], strict=True))


def open_tiff(data: Data) -> Tiff | None:
    """Return the TIFF, or None if the data do not begin with a TIFF header."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or len(data) < 16:
        return None
    (magic,) = struct.unpack_from(order + "H", data, 2)
    if magic == 42:
        return Tiff(data, order, struct.unpack_from(order + "I", data, 4)[0], is_big=False)
    if magic == 43:
        return Tiff(data, order, struct.unpack_from(order + "Q", data, 8)[0], is_big=True)
    return None
