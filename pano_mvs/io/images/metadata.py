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

import math
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pano_mvs.core.text import shortened, xml_root
from pano_mvs.scene.image_header import (
    PNG_START,
    Entry,
    ImageKind,
    Tiff,
    image_kind,
    jpeg_segments,
    open_tiff,
    riff_chunks,
    stated_size,
)

_EXIF, _XMP, _EXTENDED_XMP = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_PNG_XMP = b"XML:com.adobe.xmp"
_MAX_DECOMPRESSED_BYTES = 16 << 20  # of all compressed packets of a file together
_EXIF_IN_HEIF = re.compile(rb"Exif\0\0(?=II\*\0|MM\0\*)")


@dataclass(frozen=True)
class Container:
    """The size and the metadata of an image file."""

    size_hw: tuple[int, int] | None = None  # (height, width) as stored, or None if only decoding gives it
    exif: bytes = b""  # EXIF metadata, which begins with the byte order; empty if there is none
    xmp: tuple[bytes, ...] = ()  # XMP packets, possibly with bytes around them
    warning: str = ""  # which metadata was not read, and why; empty if all was read


def read_container(data: bytes) -> Container:
    """Return the size and the metadata of an image file; nothing of damaged or unknown files."""
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
        if marker != 0xE1:  # APP1
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
    packet = tiff.directory(tiff.first).get(700)  # XMP
    return Container(stated_size(data), data, () if packet is None else (tiff.raw(packet),))


def _read_heif(data: bytes) -> Container:
    """Read a HEIC or AVIF file, which stores EXIF uncompressed; its XMP is found by whoever searches the file."""
    found = _EXIF_IN_HEIF.search(data)
    return Container(None, b"" if found is None else data[found.end() : found.end() + 0x100000])


_READERS: Mapping[ImageKind, Callable[[bytes], Container]] = {
    "jpeg": _read_jpeg,
    "png": _read_png,
    "webp": _read_webp,
    "tiff": _read_tiff,
    "heif": _read_heif,
    "hdr": lambda data: Container(stated_size(data)),  # whoever searches the file finds its XMP
    "exr": lambda data: Container(stated_size(data)),
}


_MAKE, _MODEL, _ORIENTATION, _GPS_DIRECTORY = 0x010F, 0x0110, 0x0112, 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_EXIF_DIRECTORY, _FOCAL_35MM, _FILM_DIAGONAL_MM = 0x8769, 0xA405, 43.2666
_DAMAGE = (struct.error, IndexError, ZeroDivisionError, OverflowError)


def position_from_exif(exif: bytes) -> tuple[float, float, float] | None:
    """Return (latitude deg, longitude deg, altitude m), or None if there is no valid position.

    North, east and up are positive. A missing altitude is 0.
    """
    try:
        tiff = open_tiff(exif)
        return None if tiff is None else _position(tiff)
    except _DAMAGE:
        return None


def orientation_from_exif(exif: bytes) -> int:
    """Return the EXIF orientation, 1 to 8: how viewers rotate or mirror the image. 1, the default, is as stored."""
    try:
        tiff = open_tiff(exif)
        value = None if tiff is None else tiff.integer(tiff.directory(tiff.first).get(_ORIENTATION))
    except _DAMAGE:
        return 1
    return value if value is not None and 1 <= value <= 8 else 1


def camera_from_exif(exif: bytes) -> str:
    """Return the make and model of the camera, separated by a space; empty if not stated."""
    try:
        tiff = open_tiff(exif)
        entries = {} if tiff is None else tiff.directory(tiff.first)
        raw = [tiff.raw(entries[tag]) for tag in (_MAKE, _MODEL) if tiff is not None and tag in entries]
    except _DAMAGE:
        return ""
    return " ".join(part.split(b"\0")[0].decode("ascii", "replace").strip() for part in raw)


def focal_from_exif(exif: bytes, size_hw: tuple[int, int]) -> float | None:
    """Return the focal length in pixels, from that for 35 mm film (diagonal 43.27 mm), or None if not stated."""
    try:
        tiff = open_tiff(exif)
        offset = None if tiff is None else tiff.integer(tiff.directory(tiff.first).get(_EXIF_DIRECTORY))
        if tiff is None or offset is None:
            return None
        focal_mm = tiff.integer(tiff.directory(offset).get(_FOCAL_35MM))
    except _DAMAGE:
        return None
    return focal_mm / _FILM_DIAGONAL_MM * math.hypot(*size_hw) if focal_mm else None


def _position(tiff: Tiff) -> tuple[float, float, float] | None:
    offset = tiff.integer(tiff.directory(tiff.first).get(_GPS_DIRECTORY))
    gps = {} if offset is None else tiff.directory(offset)
    latitude = _angle(tiff, gps, _LATITUDE, reference=_LATITUDE_REF, negative=b"S")
    longitude = _angle(tiff, gps, _LONGITUDE, reference=_LONGITUDE_REF, negative=b"W")
    altitude = 0.0
    if _ALTITUDE in gps:
        heights = tiff.rationals(gps[_ALTITUDE], 1)
        altitude = math.nan if heights is None else heights[0] * _sign(tiff, gps.get(_ALTITUDE_REF), b"\1")
    usable = all(map(math.isfinite, (latitude, longitude, altitude))) and abs(latitude) <= 90 and abs(longitude) <= 180
    return (latitude, longitude, altitude) if usable else None


def _angle(tiff: Tiff, gps: Mapping[int, Entry], tag: int, *, reference: int, negative: bytes) -> float:
    if tag not in gps or reference not in gps:
        return math.nan
    angle = tiff.rationals(gps[tag], 3)
    if angle is None:
        return math.nan
    degrees, minutes, seconds = angle
    return (degrees + minutes / 60 + seconds / 3600) * _sign(tiff, gps[reference], negative)


def _sign(tiff: Tiff, entry: Entry | None, negative: bytes) -> int:
    return -1 if entry is not None and tiff.raw(entry)[:1] == negative else 1


_NAMESPACE = "{http://ns.google.com/photos/1.0/panorama/}"
_WRAPPED, _BARE = (b"<x:xmpmeta", b"</x:xmpmeta>"), (b"<rdf:RDF", b"</rdf:RDF>")
_MAX_SHOWN = 80  # characters of a field in a message


@dataclass(frozen=True)
class GPano:
    """The GPano metadata of an image."""

    projection_type: str = "equirectangular"  # "equirectangular" or, rarely, another, in lower case
    # (height, width) of the whole sphere in pixels; None for a side that is not stated
    full_size_hw: tuple[int | None, int | None] = (None, None)
    # (left, top, width, height) of the part in the image, in the same pixels; None for what is not stated
    crop_ltwh: tuple[int | None, int | None, int | None, int | None] = (None, None, None, None)
    heading_deg: float | None = None  # compass heading of the image centre, or None
    pitch_deg: float | None = None
    roll_deg: float | None = None

    @property
    def up_in_cam(self) -> tuple[float, float, float] | None:
        """The direction away from gravity, a unit vector in the camera frame, or None if it is not stated.

        (−sin r, −cos p cos r, sin p cos r) for pitch p and roll r. Eleven photographs of known
        orientation confirm the signs.
        """
        if self.pitch_deg is None or self.roll_deg is None:
            return None
        pitch, roll = math.radians(self.pitch_deg), math.radians(self.roll_deg)
        return -math.sin(roll), -math.cos(pitch) * math.cos(roll), math.sin(pitch) * math.cos(roll)

    def turned_unknown(self) -> GPano:
        """Return the metadata of an image of which it is unknown where on the horizon it begins.

        It has no heading then, and pitch and roll, which are about axes through its middle, only if both are 0.
        """
        is_level = self.pitch_deg == self.roll_deg == 0
        level_deg = 0.0 if is_level else None
        return replace(self, heading_deg=None, pitch_deg=level_deg, roll_deg=level_deg)


def find_gpano(chunks: Iterable[bytes], data: bytes = b"") -> tuple[GPano | None, tuple[str, ...]]:
    """Return the GPano metadata of an image file, if any, and warnings.

    Args:
        chunks: the XMP metadata of the container.
        data: the whole file, which is searched if the chunks have no GPano fields: some programs append packets behind
            the pixels, and HEIC and AVIF containers are not parsed.

    Returns:
        The metadata or None, and warnings about malformed packets and fields, which are ignored.
    """
    warnings: list[str] = []
    seen: set[bytes] = set()
    for source in (*chunks, data):
        for packet in _packets(source):
            if packet in seen:
                continue
            seen.add(packet)
            try:
                fields = _fields(packet)
            except ValueError as error:
                if len(warnings) < 3:
                    warnings.append(f"its XMP metadata is malformed ({error}) and was ignored")
                continue
            if fields:
                return _gpano(fields, warnings), tuple(warnings)
    return None, tuple(warnings)


def _packets(source: bytes) -> Iterator[bytes]:
    """Yield all XMP packets in the data."""
    wrapped = list(_between(source, *_WRAPPED))
    yield from wrapped or _between(source, *_BARE)


def _between(source: bytes, start_mark: bytes, end_mark: bytes) -> Iterator[bytes]:
    """Yield all parts of at most 1 MiB from a start mark to the next end mark, inclusive."""
    start = source.find(start_mark)
    while start >= 0:
        end = source.find(end_mark, start)
        if end < 0:
            return
        if end - start <= 1 << 20:
            yield source[start : end + len(end_mark)]
        start = source.find(start_mark, end)


def _fields(packet: bytes) -> dict[str, str]:
    """Return the GPano fields of a packet, from elements and from attributes."""
    fields: dict[str, str] = {}
    for element in xml_root(packet).iter():
        named = [(element.tag, element.text or ""), *element.attrib.items()]
        for name, value in named:
            if name.startswith(_NAMESPACE) and value.strip():
                fields.setdefault(name.removeprefix(_NAMESPACE), value.strip())
    return fields


def _gpano(fields: dict[str, str], warnings: list[str]) -> GPano:
    """Return the record; invalid fields are ignored with a warning."""

    def number(name: str) -> float | None:
        text = fields.get(name)
        if text is None:
            return None
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            warnings.append(f"its GPano field {name} is {shortened(text, _MAX_SHOWN)!r}, not a number, and was ignored")
            return None
        return value

    def pixels(name: str, least: int) -> int | None:
        value = number(name)
        if value is not None and value < least:
            warnings.append(f"its GPano field {name} is {fields[name]}, which no image has, and was ignored")
            return None
        return None if value is None else int(value)

    full = pixels("FullPanoHeightPixels", 1), pixels("FullPanoWidthPixels", 1)
    corner = pixels("CroppedAreaLeftPixels", 0), pixels("CroppedAreaTopPixels", 0)
    size = pixels("CroppedAreaImageWidthPixels", 1), pixels("CroppedAreaImageHeightPixels", 1)
    angles = (number("PoseHeadingDegrees"), number("PosePitchDegrees"), number("PoseRollDegrees"))
    kind = shortened(fields.get("ProjectionType", "equirectangular").lower(), _MAX_SHOWN)
    return GPano(kind, full, (*corner, *size), *angles)


_JPEG_XMP, _GPANO_WRITER_PNG_XMP = b"http://ns.adobe.com/xap/1.0/\0", b"XML:com.adobe.xmp"
_PACKET = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
    '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
    'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"{fields}/></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
)


def add_level_gpano(path: Path, size_hw: tuple[int, int], *, heading_deg: float | None, level: bool) -> None:
    """Add the metadata of a panorama of the whole sphere to a JPEG or PNG file.

    Args:
        path: the file, as OpenCV writes it.
        heading_deg: compass heading of its middle; None is not stated.
        level: whether to state that pitch and roll are 0.
    """
    height, width = size_hw
    fields: dict[str, object] = {"UsePanoramaViewer": "True", "ProjectionType": "equirectangular"}
    for name in ("FullPano", "CroppedAreaImage"):
        fields |= {f"{name}WidthPixels": width, f"{name}HeightPixels": height}
    fields |= {"CroppedAreaLeftPixels": 0, "CroppedAreaTopPixels": 0}
    fields |= {"PosePitchDegrees": 0, "PoseRollDegrees": 0} if level else {}
    fields |= {} if heading_deg is None else {"PoseHeadingDegrees": f"{heading_deg % 360:.6g}"}
    stated = "".join(f' GPano:{name}="{value}"' for name, value in fields.items())
    packet = _PACKET.format(fields=stated).encode()
    data = path.read_bytes()
    if data.startswith(b"\x89PNG"):
        chunk = b"iTXt" + _GPANO_WRITER_PNG_XMP + b"\0" * 5 + packet
        framed = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        at = 8 + 25  # behind the signature and IHDR
    else:
        framed = b"\xff\xe1" + struct.pack(">H", 2 + len(_JPEG_XMP) + len(packet)) + _JPEG_XMP + packet
        at = 4 + struct.unpack(">H", data[4:6])[0] if data[2:4] == b"\xff\xe0" else 2
    path.write_bytes(data[:at] + framed + data[at:])
