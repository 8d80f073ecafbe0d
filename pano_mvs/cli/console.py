"""The console of all commands, which protects the terminal from control characters and overlong lines."""

from __future__ import annotations

from collections.abc import Iterable

import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.segment import Segment

from pano_mvs.core.text import shortened, without_controls

_MAX_LINE = 10_000


class Console(rich.console.Console):
    """A console that escapes control characters and cuts overlong lines."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render an object; only the console's own colours and cursor movements remain."""
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(shortened(without_controls(segment.text), _MAX_LINE), segment.style)
