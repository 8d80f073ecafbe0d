"""The console of all commands, which protects the terminal from control characters and overlong lines."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.segment import Segment

from pano_mvs.core.text import shortened, without_controls

if TYPE_CHECKING:
    from rich.table import Table

_WIDEST = 10_000  # characters of a table that is not shown on a terminal


class Console(rich.console.Console):
    """A console that escapes control characters and cuts overlong lines."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render an object; only the console's own colours and cursor movements remain."""
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(shortened(without_controls(segment.text), 10_000), segment.style)

    def say(self, text: str) -> None:
        """Print text with markup, without wrapping it and without colours of numbers and paths."""
        self.print(text, highlight=False, soft_wrap=True)

    def show(self, table: Table) -> None:
        """Print a table: as wide as a terminal is, and elsewhere, such as in a file, as wide as its texts need."""
        if self.is_terminal:
            self.print(table)
            return
        usual = self.width
        self.width = max(usual, self.measure(table, options=self.options.update(width=_WIDEST)).maximum)
        try:
            self.print(table)
        finally:
            self.width = usual


def print_json(values: Mapping[str, object]) -> None:
    """Print one JSON object to the standard output."""
    print(json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False))
