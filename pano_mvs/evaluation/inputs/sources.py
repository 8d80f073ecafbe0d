"""Inputs that are a path or a value in memory."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

Source = TypeVar("Source")


def as_path(source: Source | str) -> Source | Path:
    """Return a text as a path, and anything else as it is."""
    return Path(source) if isinstance(source, str) else source


def source_name(source: object) -> str:
    """Return the name of an input for display: its path, or its type if it is in memory."""
    return str(source) if isinstance(source, Path) else f"{type(source).__name__} in memory"
