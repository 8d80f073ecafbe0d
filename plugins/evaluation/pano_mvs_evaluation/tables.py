"""Results as text: lines and tables, independent of how they are displayed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pano_mvs.core.text import finite_or_none


@dataclass(frozen=True)
class TextTable:
    """A table of text cells."""

    headings: tuple[str, ...]  # one per column
    rows: tuple[tuple[str, ...], ...]
    # a second line of each row, such as the scores of a constant; empty without
    baselines: tuple[tuple[str, ...], ...] = ()

    def __str__(self) -> str:
        lines = [self.headings]
        for idx, row in enumerate(self.rows):
            lines += [row, *self.baselines[idx : idx + 1]]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


Summary = tuple[str | TextTable, ...]  # lines of text and tables, in the order in which they are displayed


def finite_values(values: Mapping[str, float]) -> dict[str, float | None]:
    """Return named numbers for JSON, None for NaN and infinity."""
    return {name: finite_or_none(value) for name, value in values.items()}
