"""The console of all commands: nothing that files, plugins or exceptions say can steer the terminal or flood it."""

from __future__ import annotations

from collections.abc import Iterable

import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.segment import Segment

from pano_mvs.core.text import shortened, without_controls

_MAX_LINE = 10_000


class Console(rich.console.Console):
    """A console that spells control characters out, and cuts lines that nobody would read."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render an object; colours and cursor movements are the console's own and stay."""
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(shortened(without_controls(segment.text), _MAX_LINE), segment.style)
