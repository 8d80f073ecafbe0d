"""Read the size and the EXIF and XMP metadata of image files, without decoding their pixels.

JPEG: ITU-T T.81 and Adobe's XMP specification, part 3 (with extended XMP). PNG: the chunks eXIf and iTXt. WebP: the
RIFF chunks EXIF and XMP. TIFF: the first directory, with XMP in tag 700. HEIC and AVIF: the EXIF item is found by its
signature.

Pillow reads such metadata too, but not as robustly, so that it is not used here. `Image.open` reads a PNG only up to
its pixels, and refuses all of it if a compressed text is large; it refuses truncated WebP and floating-point TIFF
files; it does not join extended XMP. Its EXIF reader stops at the first entry that points outside of the data, so that
the position behind it is lost. It reports damage through `warnings`, whose filters belong to the process and not to a
thread, and applies a limit on pixels of its own, which is global too.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from pano_mvs.scene.image_files.header import PNG_START, ImageKind, image_kind, riff_chunks, stated_size
from pano_mvs.scene.image_files.jpeg import jpeg_segments
from pano_mvs.scene.image_files.tiff_directory import open_tiff

_EXIF, _XMP, _EXTENDED_XMP = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_PNG_XMP = b"XML:com.adobe.xmp"
_APP1 = 0xE1
_TIFF_XMP = 700
_MAX_DECOMPRESSED_BYTES = 16 << 20  # of all compressed packets of a file together
_MAX_HEIF_EXIF_BYTES = 1 << 20
_EXIF_IN_HEIF = re.compile(rb"Exif\0\0(?=II\*\0|MM\0\*)")


@dataclass(frozen=True)
class Container:
    """The size and the metadata of an image file.

    Attributes:
        size_hw: (height, width) as stored, or None if only decoding gives it.
        exif: EXIF metadata, which begins with the byte order; empty if there is none.
        xmp: XMP packets, possibly with bytes around them.
        warning: which metadata was not read, and why; empty if all was read.
    """

    size_hw: tuple[int, int] | None = None
    exif: bytes = b""
    xmp: tuple[bytes, ...] = ()
    warning: str = ""


def read_container(data: bytes) -> Container:
    """Return the size and the metadata of an image file; nothing of damaged or unknown files.

    Args:
        data: all bytes of the file, since metadata may be behind the pixels.
    """
    kind = image_kind(data)
    if kind is None:
        return Container()
    try:
        return _READERS[kind](data)
    except (struct.error, IndexError, OverflowError, MemoryError):
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
        elif body.startswith(_EXTENDED_XMP):
            guid, _, offset = struct.unpack_from(">32sII", body, len(_EXTENDED_XMP))
            extended.setdefault(guid, {}).setdefault(offset, body[len(_EXTENDED_XMP) + 40 :])
    joined = [b"".join(piece for _, piece in sorted(pieces.items())) for pieces in extended.values()]
    return Container(stated_size(data), exif, (*packets, *joined))


def _read_png(data: bytes) -> Container:
    exif, warning = b"", ""
    packets: list[bytes] = []
    remaining = _MAX_DECOMPRESSED_BYTES
    for kind, start, end in _png_chunks(data):
        if kind == b"eXIf":
            exif = exif or data[start:end].removeprefix(_EXIF)
        elif kind == b"iTXt" and (text := _xmp_text(data[start:end])) is not None:
            packet, is_compressed = text
            if is_compressed:
                packet = _decompressed(packet, max_bytes=remaining + 1)
                remaining -= len(packet)
            if remaining < 0:
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
    """Return the XMP packet in an iTXt chunk and whether it is compressed, or None if the chunk has another text."""
    keyword, _, rest = chunk.partition(b"\0")
    fields = rest[2:].split(b"\0", 2)  # language, translated keyword, text
    return (fields[2], rest[:1] == b"\1") if keyword == _PNG_XMP and len(fields) == 3 else None


def _decompressed(packet: bytes, *, max_bytes: int) -> bytes:
    """Return at most `max_bytes` of a decompressed packet; nothing of a damaged one."""
    try:
        return zlib.decompressobj().decompress(packet, max_bytes)
    except zlib.error:
        return b""


def _read_webp(data: bytes) -> Container:
    chunks = [(kind, data[start:end]) for kind, start, end in riff_chunks(data) if kind in (b"EXIF", b"XMP ")]
    exif = next((body.removeprefix(_EXIF) for kind, body in chunks if kind == b"EXIF"), b"")
    return Container(stated_size(data), exif, tuple(body for kind, body in chunks if kind == b"XMP "))


def _read_tiff(data: bytes) -> Container:
    tiff = open_tiff(data)
    if tiff is None:
        return Container()
    packet = tiff.directory(tiff.first).get(_TIFF_XMP)
    return Container(stated_size(data), data, () if packet is None else (tiff.raw(packet),))


def _read_heif(data: bytes) -> Container:
    """Read a HEIC or AVIF file, which stores EXIF uncompressed; its XMP is found by whoever searches the file."""
    found = _EXIF_IN_HEIF.search(data)
    return Container(None, b"" if found is None else data[found.end() : found.end() + _MAX_HEIF_EXIF_BYTES])


_READERS: Mapping[ImageKind, Callable[[bytes], Container]] = {
    "jpeg": _read_jpeg,
    "png": _read_png,
    "webp": _read_webp,
    "tiff": _read_tiff,
    "heif": _read_heif,
}
