"""The segments of a JPEG file, which contain its metadata and its pixels (ITU-T T.81, annex B)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

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
