"""The segments of a JPEG file: where its metadata and its pixels stand (ITU-T T.81, annex B)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

JPEG_START = b"\xff\xd8"
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Start-of-frame markers: C0–CF without the tables DHT (C4), JPG (C8) and DAC (CC)."""
_SCAN, _END = 0xDA, b"\xff\xd9"
_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers that have no length: TEM, RST0 to RST7, SOI


class Segment(NamedTuple):
    """One segment: its marker's second byte, and where what follows its length begins and ends."""

    marker: int
    start: int
    end: int


def jpeg_segments(data: bytes) -> Iterator[Segment]:
    """Yield the segments of a JPEG up to the header of its first scan, that one included.

    A file that is no JPEG, or is damaged, yields what can be read up to there.
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
    """Return whether a JPEG ends before its end marker: decoders fill what is missing with grey and say nothing.

    The marker cannot occur within a scan, and what cameras append behind it (videos, previews) does not matter.
    """
    scan = next((segment for segment in jpeg_segments(data) if segment.marker == _SCAN), None)
    return scan is None or data.find(_END, scan.end) < 0
