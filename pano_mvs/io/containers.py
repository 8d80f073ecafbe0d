"""Where picture files keep their metadata: the parts of JPEG, PNG, WebP, TIFF and HEIF/AVIF files that matter here.

JPEG: ITU-T T.81 and Adobe's XMP specification, part 3 (with extended XMP). PNG: the chunks IHDR, eXIf and iTXt.
WebP: the RIFF chunks VP8, VP8L, VP8X, EXIF and XMP. TIFF: the first directory, XMP in tag 700.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from pano_mvs.io.tiff_directory import open_tiff
from pano_mvs.scene.jpeg import JPEG_FRAMES, JPEG_START, jpeg_segments

_PNG_START = b"\x89PNG\r\n\x1a\n"
_EXIF, _XMP, _MORE_XMP = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_APP1 = 0xE1
_WIDTH, _HEIGHT, _TIFF_XMP = 256, 257, 700
_MOST_XMP_BYTES = 64 << 20
_MOST_EXIF_BYTES = 1 << 20
_EXIF_IN_HEIF = re.compile(rb"Exif\0\0(?=II\*\0|MM\0\*)")


@dataclass(frozen=True)
class Container:
    """What the container of a picture says of it.

    Attributes:
        size_hw: (height, width) as stored, or None where only decoding tells.
        exif: EXIF metadata from their byte order on; empty where there are none.
        xmp: XMP packets, whole or with what surrounds them.
    """

    size_hw: tuple[int, int] | None = None
    exif: bytes = b""
    xmp: tuple[bytes, ...] = ()


def read_container(data: bytes) -> Container:
    """Return what the container of a picture says; nothing of what is damaged or of another kind.

    Args:
        data: the file's bytes, all of them: metadata may stand behind the pixels.
    """
    for begins, read in _READERS:
        if begins(data):
            try:
                return read(data)
            except (struct.error, IndexError, OverflowError, MemoryError):
                return Container()
    return Container()


def _read_jpeg(data: bytes) -> Container:
    size: tuple[int, int] | None = None
    exif = b""
    packets: list[bytes] = []
    extended: dict[bytes, dict[int, bytes]] = {}
    for marker, start, end in jpeg_segments(data):
        if marker in JPEG_FRAMES and size is None:
            size = _sound(*struct.unpack_from(">HH", data, start + 1))
        if marker != _APP1:
            continue
        body = data[start:end]
        if body.startswith(_EXIF):
            exif = exif or body[len(_EXIF) :]
        elif body.startswith(_XMP):
            packets.append(body[len(_XMP) :])
        elif body.startswith(_MORE_XMP):
            guid, offset, part = _extension(body[len(_MORE_XMP) :])
            extended.setdefault(guid, {}).setdefault(offset, part)
    joined = [b"".join(part for _, part in sorted(parts.items())) for parts in extended.values()]
    return Container(size, exif, (*packets, *joined))


def _extension(body: bytes) -> tuple[bytes, int, bytes]:
    """Return the digest of an extended packet, the place of a piece in it, and the piece."""
    _, offset = struct.unpack_from(">II", body, 32)
    return body[:32], offset, body[40:]


def _read_png(data: bytes) -> Container:
    size: tuple[int, int] | None = None
    exif = b""
    packets: list[bytes] = []
    for kind, start, end in _png_chunks(data):
        if kind == b"IHDR":
            width, height = struct.unpack_from(">II", data, start)
            size = _sound(height, width)
        elif kind == b"eXIf":
            exif = exif or data[start:end].removeprefix(_EXIF)
        elif kind == b"iTXt":
            packets.extend(_international_text(data[start:end]))
    return Container(size, exif, tuple(packets))


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    offset = len(_PNG_START)
    while offset + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        yield kind, offset + 8, min(offset + 8 + length, len(data))
        offset += 12 + length


def _international_text(chunk: bytes) -> Iterator[bytes]:
    """Yield the XMP packet of a PNG's international text chunk, decompressed, if it is one."""
    keyword, _, rest = chunk.partition(b"\0")
    parts = rest[2:].split(b"\0", 2)
    if keyword != b"XML:com.adobe.xmp" or len(parts) != 3:
        return
    try:
        yield zlib.decompressobj().decompress(parts[2], _MOST_XMP_BYTES) if rest[:1] == b"\1" else parts[2]
    except zlib.error:
        return


def _read_webp(data: bytes) -> Container:
    size: tuple[int, int] | None = None
    exif = b""
    packets: list[bytes] = []
    for kind, start, end in _riff_chunks(data):
        if kind in _WEBP_SIZES:
            size = size or _sound(*_WEBP_SIZES[kind](data, start))
        elif kind == b"EXIF":
            exif = exif or data[start:end].removeprefix(_EXIF)
        elif kind == b"XMP ":
            packets.append(data[start:end])
    return Container(size, exif, tuple(packets))


def _riff_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    offset = 12
    while offset + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, offset)
        yield kind, offset + 8, min(offset + 8 + length, len(data))
        offset += 8 + length + length % 2


def _canvas(data: bytes, start: int) -> tuple[int, int]:
    low_width, high_width, low_height, high_height = struct.unpack_from("<HBHB", data, start + 4)
    return (high_height << 16 | low_height) + 1, (high_width << 16 | low_width) + 1


def _lossy(data: bytes, start: int) -> tuple[int, int]:
    width, height = struct.unpack_from("<HH", data, start + 6)
    return height & 0x3FFF, width & 0x3FFF


def _lossless(data: bytes, start: int) -> tuple[int, int]:
    (bits,) = struct.unpack_from("<I", data, start + 1)
    return (bits >> 14 & 0x3FFF) + 1, (bits & 0x3FFF) + 1


_WEBP_SIZES: dict[bytes, Callable[[bytes, int], tuple[int, int]]] = {
    b"VP8X": _canvas,
    b"VP8 ": _lossy,
    b"VP8L": _lossless,
}


def _read_tiff(data: bytes) -> Container:
    tiff = open_tiff(data)
    if tiff is None:
        return Container()
    entries = tiff.directory(tiff.first)
    height, width = tiff.integer(entries.get(_HEIGHT)), tiff.integer(entries.get(_WIDTH))
    packet = entries.get(_TIFF_XMP)
    return Container(_sound(height or 0, width or 0), data, () if packet is None else (tiff.raw(packet),))


def _read_heif(data: bytes) -> Container:
    """Read HEIC and AVIF, which keep both kinds of metadata as they are; their packets are found by their marks."""
    found = _EXIF_IN_HEIF.search(data)
    return Container(None, b"" if found is None else data[found.end() : found.end() + _MOST_EXIF_BYTES], ())


def _sound(height: int, width: int) -> tuple[int, int] | None:
    return (height, width) if height and width else None


_READERS: tuple[tuple[Callable[[bytes], bool], Callable[[bytes], Container]], ...] = (
    (lambda data: data.startswith(JPEG_START), _read_jpeg),
    (lambda data: data.startswith(_PNG_START), _read_png),
    (lambda data: data.startswith(b"RIFF") and data[8:12] == b"WEBP", _read_webp),
    (lambda data: data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), _read_tiff),
    (lambda data: data[4:8] == b"ftyp", _read_heif),
)
