"""Canonical digests of plain values: equal values give equal digests, on every machine.

The encoding is type-tagged, so `1`, `1.0`, `True` and `"1"` differ. Floats are written in hex, so no digit is lost. NaN
and infinities are refused, because NaN is not equal to itself and would never be found again.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from pano_mvs.core.errors import UsageError

DIGEST_BYTES = 16
IS_DIGEST = re.compile(rf"[0-9a-f]{{{2 * DIGEST_BYTES}}}")
"""Matches the digests that the functions below return."""


def digest_from_value(value: object) -> str:
    """Return the hex digest of a tree of None, bool, int, float, str, bytes, list, tuple and dict.

    Raises:
        UsageError: if the tree holds another type, a NaN or an infinity.
    """
    encoder = _Encoder()
    encoder.add(value)
    return encoder.digest()


def digest_from_bytes(data: bytes | memoryview) -> str:
    """Return the hex digest of a byte string."""
    return hashlib.blake2b(data, digest_size=DIGEST_BYTES).hexdigest()


def digest_from_file(path: Path) -> str:
    """Return the hex digest of a file's bytes."""
    with path.open("rb") as stream:
        return digest_from_stream(stream)


def digest_from_stream(stream: IO[bytes]) -> str:
    """Return the hex digest of the rest of a binary stream."""
    hasher = hashlib.blake2b(digest_size=DIGEST_BYTES)
    while chunk := stream.read(1 << 20):
        hasher.update(chunk)
    return hasher.hexdigest()


class _Encoder:
    """Computes the digest of the canonical form, of which only a part is in memory at a time."""

    def __init__(self) -> None:
        self._hasher = hashlib.blake2b(digest_size=DIGEST_BYTES)
        self._chunks: list[bytes] = []

    def digest(self) -> str:
        self._flush()
        return self._hasher.hexdigest()

    def add(self, value: object) -> None:
        """Append the canonical form. The most frequent type comes first, because a plan encodes 100,000 keys."""
        chunks = self._chunks
        if isinstance(value, str):
            text = value.encode()
            chunks.append(b"s%d:%b" % (len(text), text))
            return
        match value:
            case bool():
                chunks.append(b"b1;" if value else b"b0;")
            case int():
                chunks.append(b"i%d;" % value)
            case float():
                if not math.isfinite(value):
                    raise UsageError(f"{value} cannot be part of a cache key: use None, or a finite number")
                chunks.append(b"f" + (value + 0.0).hex().encode() + b";")
            case None:
                chunks.append(b"n;")
            case list() | tuple():
                chunks.append(b"l%d:" % len(value))
                for item in value:
                    self.add(item)
            case dict() | Mapping():
                chunks.append(b"d%d:" % len(value))
                for key in sorted(value, key=str):
                    self.add(key)
                    self.add(value[key])
            case bytes():
                chunks.append(b"y%d:" % len(value) + value)
            case _:
                raise UsageError(f"a {type(value).__name__} has no canonical form and cannot be part of a cache key")
        if len(chunks) > 10_000:
            self._flush()

    def _flush(self) -> None:
        self._hasher.update(b"".join(self._chunks))
        self._chunks.clear()
