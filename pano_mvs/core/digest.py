"""Canonical digests of plain values: equal values give equal digests, on every machine.

The encoding is type-tagged, so `1`, `1.0`, `True` and `"1"` differ; floats are written in hex, so
no digit is lost; NaN and infinities are refused, since a key that is not equal to itself finds nothing.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

from pano_mvs.core.errors import UsageError

DIGEST_BYTES = 16


def digest_from_value(value: object) -> str:
    """Return the hex digest of a tree of None, bool, int, float, str, bytes, list, tuple and dict.

    Raises:
        UsageError: if the tree holds another type, a NaN or an infinity.
    """
    hasher = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for chunk in _encode(value):
        hasher.update(chunk)
    return hasher.hexdigest()


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


def _encode(value: object) -> Iterator[bytes]:
    match value:
        case None:
            yield b"n;"
        case bool():
            yield b"b1;" if value else b"b0;"
        case int():
            yield b"i%d;" % value
        case float():
            if not math.isfinite(value):
                raise UsageError(f"{value} has no place in a cache key: use None, or a finite number")
            yield b"f" + (value + 0.0).hex().encode() + b";"
        case str():
            text = value.encode()
            yield b"s%d:" % len(text) + text
        case bytes():
            yield b"y%d:" % len(value) + value
        case list() | tuple():
            yield b"l%d:" % len(value)
            for item in value:
                yield from _encode(item)
        case Mapping():
            yield b"d%d:" % len(value)
            for key in sorted(value, key=str):
                yield from _encode(key)
                yield from _encode(value[key])
        case _:
            raise UsageError(f"a {type(value).__name__} has no canonical form and cannot be part of a cache key")
