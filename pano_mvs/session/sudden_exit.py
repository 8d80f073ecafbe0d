"""Handle `sys.exit` and `os._exit` in the code of plugins, which must not end a run silently."""

from __future__ import annotations

import os
import threading
from typing import NoReturn


class SuddenExit(SystemExit):
    """Raised instead of calling os._exit, which would end this process without a message."""


def exit_text(end: SystemExit) -> str:
    """Return how a program ended itself, such as `sys.exit(0)`."""
    return str(end) if isinstance(end, SuddenExit) else f"sys.exit({'' if end.code is None else end.code})"


def turn_exits_into_errors() -> None:
    """Let os._exit raise SuddenExit in this thread, so that a plugin that calls it cannot end a run silently.

    In another thread os._exit still ends the process, but never with exit code 0; in a forked child it is unchanged.
    Exits of native code cannot be caught.
    """
    exit_now, process, thread = os._exit, os.getpid(), threading.get_ident()

    def refuse(status: int) -> NoReturn:
        if os.getpid() == process and threading.get_ident() == thread:
            raise SuddenExit(f"os._exit({status})")
        exit_now((status or 1) if os.getpid() == process else status)

    os._exit = refuse
