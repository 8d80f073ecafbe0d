"""The position, the orientation and the focal length in the EXIF metadata of an image.

EXIF 2.32: sections 4.6.4 (the tag Orientation), 4.6.5 (FocalLengthIn35mmFilm) and 4.6.6 (GPS attributes). EXIF is a
TIFF without an image. See `containers` for why Pillow does not read it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from pano_mvs.scene.image_files.tiff_directory import Entry, Tiff, open_tiff

_ORIENTATION, _GPS_DIRECTORY = 0x0112, 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_EXIF_DIRECTORY, _FOCAL_35MM, _FILM_DIAGONAL_MM = 0x8769, 0xA405, 43.2666
_DAMAGE = (struct.error, IndexError, ZeroDivisionError, OverflowError)


def position_from_exif(exif: bytes) -> tuple[float, float, float] | None:
    """Return (latitude deg, longitude deg, altitude m), or None if there is no valid position.

    North, east and up are positive. A missing altitude is 0.

    Args:
        exif: the metadata, which begins with the byte order, "II" or "MM".
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


def focal_from_exif(exif: bytes, size_hw: tuple[int, int]) -> float | None:
    """Return the focal length in pixels, from that for 35 mm film (whose diagonal is 43.27 mm), or None if not stated.

    Args:
        exif: the metadata.
        size_hw: (height, width) of the picture.
    """
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
