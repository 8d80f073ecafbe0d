"""Google's photo sphere metadata (GPano XMP): the projection, the part of the sphere, and the camera's orientation.

The fields are those of the "Photo Sphere XMP Metadata" specification. Cameras write them as elements, editors as
attributes. Both are read, from the container's metadata or, without those, from packets anywhere in the file.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from xml.etree import ElementTree

_NAMESPACE = "{http://ns.google.com/photos/1.0/panorama/}"
_WRAPPED, _BARE = (b"<x:xmpmeta", b"</x:xmpmeta>"), (b"<rdf:RDF", b"</rdf:RDF>")
_PACKET_BYTES = 1 << 20
_MAX_WARNINGS = 3


@dataclass(frozen=True)
class GPano:
    """The GPano metadata of an image.

    Attributes:
        projection_type: "equirectangular" or, rarely, another, in lower case.
        full_size_hw: (height, width) of the whole sphere in pixels, or None.
        crop_ltwh: (left, top, width, height) of the part in the image, in the same pixels, or None.
        heading_deg: compass heading of the image centre, or None.
        pitch_deg: pitch of the camera, or None.
        roll_deg: roll of the camera, or None.
    """

    projection_type: str = "equirectangular"
    full_size_hw: tuple[int, int] | None = None
    crop_ltwh: tuple[int, int, int, int] | None = None
    heading_deg: float | None = None
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
            except (ElementTree.ParseError, ValueError) as error:
                if len(warnings) < _MAX_WARNINGS:
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
        if end - start <= _PACKET_BYTES:
            yield source[start : end + len(end_mark)]
        start = source.find(start_mark, end)


def _fields(packet: bytes) -> dict[str, str]:
    """Return the GPano fields of a packet, from elements and from attributes."""
    upper = packet.upper()
    if b"<!DOCTYPE" in upper or b"<!ENTITY" in upper:
        raise ValueError("it declares XML entities")
    fields: dict[str, str] = {}
    for element in ElementTree.fromstring(packet).iter():  # noqa: S314  # no DTD gets this far
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
            warnings.append(f"its GPano field {name} is {text!r}, not a number, and was ignored")
            return None
        return value

    full = _pixels(number("FullPanoHeightPixels"), number("FullPanoWidthPixels"))
    part = _pixels(number("CroppedAreaImageWidthPixels"), number("CroppedAreaImageHeightPixels"))
    left, top = int(number("CroppedAreaLeftPixels") or 0), int(number("CroppedAreaTopPixels") or 0)
    crop = None if part is None else (left, top, *part)
    if full and crop and not (0 <= left <= full[1] - crop[2] and 0 <= top <= full[0] - crop[3]):
        warnings.append(f"its GPano cropped area {crop} does not lie within {full[1]}×{full[0]} px and was ignored")
        crop = None
    angles = (number("PoseHeadingDegrees"), number("PosePitchDegrees"), number("PoseRollDegrees"))
    return GPano(fields.get("ProjectionType", "equirectangular").lower(), full, crop, *angles)


def _pixels(first: float | None, second: float | None) -> tuple[int, int] | None:
    if first is None or second is None or min(first, second) < 1:
        return None
    return int(first), int(second)
