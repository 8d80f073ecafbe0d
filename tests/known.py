"""Take a value that may be None in general and is not in a test."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def known(value: T | None) -> T:
    """Return the value, and fail if there is none."""
    assert value is not None
    return value
