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

from pano_mvs.scene.image_files.header import PNG_START, TIFF_STARTS, riff_chunks, stated_size
from pano_mvs.scene.image_files.jpeg import JPEG_START, jpeg_segments
from pano_mvs.scene.image_files.tiff_directory import open_tiff

_EXIF, _XMP, _MORE_XMP = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_APP1 = 0xE1
_TIFF_XMP = 700
_MAX_DECOMPRESSED_BYTES = 16 << 20  # of all compressed packets of a file together
_MOST_EXIF_BYTES = 1 << 20
_EXIF_IN_HEIF = re.compile(rb"Exif\0\0(?=II\*\0|MM\0\*)")


@dataclass(frozen=True)
class Container:
    """What the container of a picture says of it.

    Attributes:
        size_hw: (height, width) as stored, or None where only decoding tells.
        exif: EXIF metadata from their byte order on; empty where there are none.
        xmp: XMP packets, whole or with what surrounds them.
        warning: what of the metadata was not read although it is there, and why; empty if all was.
    """

    size_hw: tuple[int, int] | None = None
    exif: bytes = b""
    xmp: tuple[bytes, ...] = ()
    warning: str = ""


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
    exif = b""
    packets: list[bytes] = []
    extended: dict[bytes, dict[int, bytes]] = {}
    for marker, start, end in jpeg_segments(data):
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
    return Container(stated_size(data), exif, (*packets, *joined))


def _extension(body: bytes) -> tuple[bytes, int, bytes]:
    """Return the digest of an extended packet, the place of a piece in it, and the piece."""
    _, offset = struct.unpack_from(">II", body, 32)
    return body[:32], offset, body[40:]


def _read_png(data: bytes) -> Container:
    exif, warning = b"", ""
    packets: list[bytes] = []
    left = _MAX_DECOMPRESSED_BYTES
    for kind, start, end in _png_chunks(data):
        if kind == b"eXIf":
            exif = exif or data[start:end].removeprefix(_EXIF)
        elif kind == b"iTXt" and (text := _xmp_text(data[start:end])) is not None:
            packet, is_compressed = text
            if is_compressed:
                packet = _decompressed(packet, left + 1)
                left -= len(packet)
            if left < 0:
                limit = _MAX_DECOMPRESSED_BYTES >> 20
                warning = f"its compressed XMP metadata is larger than {limit} MiB and was not read to its end"
                break
            packets.append(packet)
    return Container(stated_size(data), exif, tuple(packets), warning)


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    offset = len(PNG_START)
    while offset + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        yield kind, offset + 8, min(offset + 8 + length, len(data))
        offset += 12 + length


def _xmp_text(chunk: bytes) -> tuple[bytes, bool] | None:
    """Return the XMP packet in a PNG's international text chunk, and whether it is compressed; None if it has none."""
    keyword, _, rest = chunk.partition(b"\0")
    parts = rest[2:].split(b"\0", 2)
    if keyword != b"XML:com.adobe.xmp" or len(parts) != 3:
        return None
    return parts[2], rest[:1] == b"\1"


def _decompressed(packet: bytes, most: int) -> bytes:
    """Return a packet decompressed, up to a number of bytes; nothing of one that is damaged."""
    try:
        return zlib.decompressobj().decompress(packet, most)
    except zlib.error:
        return b""


def _read_webp(data: bytes) -> Container:
    exif = b""
    packets: list[bytes] = []
    for kind, start, end in riff_chunks(data):
        if kind == b"EXIF":
            exif = exif or data[start:end].removeprefix(_EXIF)
        elif kind == b"XMP ":
            packets.append(data[start:end])
    return Container(stated_size(data), exif, tuple(packets))


def _read_tiff(data: bytes) -> Container:
    tiff = open_tiff(data)
    if tiff is None:
        return Container()
    packet = tiff.directory(tiff.first).get(_TIFF_XMP)
    return Container(stated_size(data), data, () if packet is None else (tiff.raw(packet),))


def _read_heif(data: bytes) -> Container:
    """Read HEIC and AVIF, which keep both kinds of metadata as they are; their packets are found by their marks."""
    found = _EXIF_IN_HEIF.search(data)
    return Container(None, b"" if found is None else data[found.end() : found.end() + _MOST_EXIF_BYTES], ())


_READERS: tuple[tuple[Callable[[bytes], bool], Callable[[bytes], Container]], ...] = (
    (lambda data: data.startswith(JPEG_START), _read_jpeg),
    (lambda data: data.startswith(PNG_START), _read_png),
    (lambda data: data.startswith(b"RIFF") and data[8:12] == b"WEBP", _read_webp),
    (lambda data: data.startswith(TIFF_STARTS), _read_tiff),
    (lambda data: data[4:8] == b"ftyp", _read_heif),
)
