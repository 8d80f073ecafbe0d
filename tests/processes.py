"""Processes that tests start."""

from __future__ import annotations

import signal


def heed_interrupts() -> None:
    """Let a new process take interrupts, which one that a script starts in its background ignores; for `preexec_fn`."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
