"""Where a picture was taken, as its EXIF metadata have it.

EXIF 2.32, section 4.6.6 (GPS attributes); the container is a TIFF directory in a JPEG's APP1 or a PNG's eXIf chunk.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

_GPS_DIRECTORY = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_ASCII, _BYTE, _LONG, _RATIONAL = 2, 1, 4, 5
_MOST_ENTRIES = 1000


class _Entry(NamedTuple):
    kind: int
    length: int
    at: int  # where the value's four bytes (or the offset to it) stand


def find_gps(head: bytes) -> tuple[float, float, float] | None:
    """Return (latitude deg, longitude deg, altitude m) from the head of a picture file, or None.

    North, east and up are positive; an altitude that is not given is 0. Metadata that are damaged, or hold no fix,
    count as none.
    """
    for mark in (b"Exif\0\0", b"eXIf"):
        start = head.find(mark)
        if start >= 0:
            try:
                return _position(head[start + len(mark) :])
            except (struct.error, IndexError, ZeroDivisionError):
                return None
    return None


def _position(tiff: bytes) -> tuple[float, float, float] | None:
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return None
    (first,) = struct.unpack_from(order + "I", tiff, 4)
    pointer = _directory(tiff, first, order).get(_GPS_DIRECTORY)
    if pointer is None or pointer.kind != _LONG:
        return None
    gps = _directory(tiff, struct.unpack_from(order + "I", tiff, pointer.at)[0], order)
    if not {_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE} <= gps.keys():
        return None
    latitude = _degrees(tiff, gps[_LATITUDE], order) * _sign(tiff, gps[_LATITUDE_REF], b"S")
    longitude = _degrees(tiff, gps[_LONGITUDE], order) * _sign(tiff, gps[_LONGITUDE_REF], b"W")
    altitude = 0.0
    if _ALTITUDE in gps:
        (altitude,) = _rationals(tiff, gps[_ALTITUDE], order, 1)
        altitude *= _sign(tiff, gps[_ALTITUDE_REF], b"\1") if _ALTITUDE_REF in gps else 1
    usable = all(map(math.isfinite, (latitude, longitude, altitude))) and abs(latitude) <= 90 and abs(longitude) <= 180
    return (latitude, longitude, altitude) if usable else None


def _directory(tiff: bytes, offset: int, order: str) -> dict[int, _Entry]:
    """Return the entries of a TIFF directory by their tags."""
    (count,) = struct.unpack_from(order + "H", tiff, offset)
    entries: dict[int, _Entry] = {}
    for idx in range(min(count, _MOST_ENTRIES)):
        at = offset + 2 + 12 * idx
        tag, kind, length = struct.unpack_from(order + "HHI", tiff, at)
        entries.setdefault(tag, _Entry(kind, length, at + 8))
    return entries


def _degrees(tiff: bytes, entry: _Entry, order: str) -> float:
    degrees, minutes, seconds = _rationals(tiff, entry, order, 3)
    return degrees + minutes / 60 + seconds / 3600


def _rationals(tiff: bytes, entry: _Entry, order: str, count: int) -> list[float]:
    if entry.kind != _RATIONAL or entry.length < count:
        return [math.nan] * count
    (offset,) = struct.unpack_from(order + "I", tiff, entry.at)
    numbers = struct.unpack_from(f"{order}{2 * count}I", tiff, offset)
    return [above / below for above, below in zip(numbers[::2], numbers[1::2], strict=True)]


def _sign(tiff: bytes, entry: _Entry, negative: bytes) -> int:
    if entry.kind not in (_ASCII, _BYTE):
        return 1
    return -1 if tiff[entry.at : entry.at + 1] == negative else 1
