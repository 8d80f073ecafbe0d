"""Which processes of this host are running, and what makes a process's number mean one process."""

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
    """Return a name for that within which a process's number means one process: this start of this container."""
    marks = [socket.gethostname(), boot_id()]
    with suppress(OSError):
        marks.append(str(Path("/proc/self/ns/pid").readlink()))
    return hashlib.blake2b("\n".join(filter(None, marks)).encode(), digest_size=4).hexdigest()


def boot_id() -> str:
    """Return a text that every start of the system changes; empty if it is not known."""
    return _text("/proc/sys/kernel/random/boot_id")


def machine_id() -> str:
    """Return a text that stays the same when this installation starts again; empty if it is not known."""
    text = _text("/etc/machine-id") or _text("/var/lib/dbus/machine-id")
    return hashlib.blake2b(text.encode(), key=b"pano-mvs", digest_size=8).hexdigest() if text else ""


def is_running(process: int) -> bool:
    """Return whether there is a process with a number (POSIX)."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True


def start_of(process: int) -> str | None:
    """Return when a process was started, in the system's own words; empty if that is not known, None if it has ended.

    Two processes that had the same number one after the other differ in it.
    """
    if os.name != "posix":
        return ""
    if not is_running(process):
        return None
    fields = _text(f"/proc/{process}/stat").rpartition(")")[2].split()  # the name before may hold anything
    if fields:
        return None if fields[0] in _ENDED else fields[19]
    if exists(Path("/proc/self/stat")):  # it has just ended, or is hidden from us
        return "" if is_running(process) else None
    return _start_by_ps(process)


def _start_by_ps(process: int) -> str | None:
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
