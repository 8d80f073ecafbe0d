"""Types of settings that several stages have."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import AfterValidator


def _odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError(f"must be odd, because a window has a centre pixel: use {value - 1} or {value + 1}")
    return value


Odd: TypeAlias = Annotated[int, AfterValidator(_odd)]
"""Side length of a window."""
