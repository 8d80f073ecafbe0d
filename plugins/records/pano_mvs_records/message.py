"""A message when a run has ended in any way, through apprise."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from pano_mvs.cli.endings import ending_text
from pano_mvs.core.errors import UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.text import duration_text
from pano_mvs.session.observers import ObservedRun
from pano_mvs.session.progress import Event, RunFinished


class Message:
    """Sends a message with the verdict, and why the run ended early, when the run has ended."""

    def __init__(self, urls: Sequence[str], run: ObservedRun) -> None:
        """Check where to send it.

        Args:
            urls: as apprise writes them.

        Raises:
            UsageError: if apprise is not installed, or one is not an address that it knows.
        """
        self._messenger: Any = import_extra("apprise", "--notify", "notify").Apprise()
        for url in urls:
            if not self._messenger.add(url):
                raise UsageError(
                    f"--notify {url}: must be a URL such as mailto://user:password@example.com or ntfy://topic; "
                    "https://github.com/caronc/apprise lists all kinds"
                )
        self._places = ", ".join(url.partition(":")[0] for url in urls)  # the rest may be secret
        self._run = run
        self._began = time.monotonic()

    def __call__(self, event: Event) -> None:
        """Send the message if the event is the last one of the run; blocks of a large capture are parts of it."""
        if not isinstance(event, RunFinished) or event.out != self._run.out:
            return
        verdict = event.verdict.judgement if event.verdict is not None else ""
        lines = [verdict, event.stopped, f"{duration_text(time.monotonic() - self._began)}, {event.out.absolute()}"]
        title = f"pano-mvs: {event.out.name}: {ending_text(event.exit_code)}"
        if not self._messenger.notify(title=title, body="\n".join(filter(None, lines))):
            self._run.warn(f"the message could not be sent to {self._places}")
