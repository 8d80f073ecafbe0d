"""Directories of TIFF files, of which EXIF metadata is a kind (TIFF 6.0, section 2; BigTIFF)."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

_MAX_ENTRIES = 1000
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_INTEGERS = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
_RATIONAL = 5


class Entry(NamedTuple):
    """A field of a directory: its type, and the start and end of its bytes."""

    kind: int
    start: int
    end: int


@dataclass(frozen=True)
class Tiff:
    """A TIFF in memory.

    Attributes:
        data: its bytes.
        order: "<" or ">".
        first: offset of its first directory.
        is_big: whether it is a BigTIFF.
    """

    data: bytes
    order: str
    first: int
    is_big: bool

    def directory(self, offset: int) -> Mapping[int, Entry]:
        """Return the entries of the directory at an offset by tag, without those that point outside of the data.

        Raises:
            struct.error: if it is truncated.
        """
        head, row, wide = ("Q", "HHQ", 8) if self.is_big else ("H", "HHI", 4)
        (count,) = struct.unpack_from(self.order + head, self.data, offset)
        entries: dict[int, Entry] = {}
        for idx in range(min(count, _MAX_ENTRIES)):
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
        """Return the first `count` numbers of a field of fractions, or None if it has not as many.

        Raises:
            ZeroDivisionError: if a denominator is zero.
        """
        if entry.kind != _RATIONAL or entry.end - entry.start < 8 * count:
            return None
        numbers = struct.unpack_from(f"{self.order}{2 * count}I", self.data, entry.start)
        return tuple(above / below for above, below in zip(numbers[::2], numbers[1::2], strict=True))


def open_tiff(data: bytes) -> Tiff | None:
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
