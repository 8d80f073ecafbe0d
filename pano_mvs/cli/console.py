"""The console of all commands, which protects the terminal from control characters and overlong lines."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.segment import Segment

from pano_mvs.core.text import shortened, without_controls


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


def print_json(values: Mapping[str, object]) -> None:
    """Print one JSON object to the standard output."""
    print(json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False))
