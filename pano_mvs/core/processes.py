"""Find out which processes of this host are running, and distinguish processes that had the same id."""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
from contextlib import suppress
from functools import cache
from pathlib import Path

from pano_mvs.core.paths import exists

_ENDED = "ZX"


@cache
def process_place() -> str:
    """Return a name for the scope of process ids: the present start of this host or container."""
    marks = [socket.gethostname(), _text("/proc/sys/kernel/random/boot_id")]
    with suppress(OSError):
        marks.append(str(Path("/proc/self/ns/pid").readlink()))
    return hashlib.blake2b("\n".join(filter(None, marks)).encode(), digest_size=4).hexdigest()


def is_running(process: int) -> bool:
    """Return whether a process with this id exists (POSIX)."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True


def start_of(process: int) -> str | None:
    """Return the start time of a process in the notation of the system; "" if unknown, None if the process has ended.

    Two successive processes with the same id have different start times.
    """
    if os.name != "posix":
        return ""
    if not is_running(process):
        return None
    fields = _text(f"/proc/{process}/stat").rpartition(")")[2].split()  # the name before it may contain anything
    if fields:
        return None if fields[0] in _ENDED else fields[19]
    if exists(Path("/proc/self/stat")):  # the process has just ended, or is hidden from us
        return "" if is_running(process) else None
    command = ["ps", "-o", "lstart=", "-p", str(process)]
    try:
        found = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | {"LC_ALL": "C"})  # noqa: S603
    except OSError:
        return ""
    return " ".join(found.stdout.split()) or None


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
