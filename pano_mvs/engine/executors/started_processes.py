"""End all processes that a worker has started, even those that have left its process group.

On Linux, a worker adopts its descendants whose own parents end, so that all of them are found below it in `/proc`. If
the worker itself has ended, they are found by a mark in the environment that they inherit.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

from pano_mvs.core.paths import children

MARK = "PANO_MVS_WORKER"
"""Environment variable of a worker and of what it starts, whose value no other worker has."""


def adopt_orphans() -> None:
    """Become the parent of descendants whose own parents end; has no effect except on Linux."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER


def end_started(worker: int, mark: str) -> None:
    """End what a worker has started, and then all processes of its group, the worker included.

    Other systems than Linux do not show what has left the group.

    Args:
        worker: process id of the worker, which is the id of its group.
        mark: value of `MARK` in its environment.
    """
    with suppress(ProcessLookupError, PermissionError):
        if worker != os.getpid():
            os.kill(worker, signal.SIGSTOP)  # so that it starts no others meanwhile
    ended, unsuccessful = {worker, os.getpid()}, 0
    # A process that forks and ends while others are looked at is missed by a look, and so is its child.
    while unsuccessful < 3:
        found = _started(worker, mark) - ended
        for process in found:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        ended |= found
        unsuccessful = 0 if found else unsuccessful + 1
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(worker, signal.SIGKILL)


def _started(worker: int, mark: str) -> set[int]:
    """Return the processes below a worker, and those that bear its mark."""
    parents: dict[int, int] = {}
    found = {worker}
    for folder in children(Path("/proc"), "[0-9]*"):
        with suppress(OSError):  # it has ended, or belongs to another user
            parents[int(folder.name)] = int((folder / "stat").read_bytes().rpartition(b")")[2].split()[1])
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes().split(b"\0"):
                found.add(int(folder.name))
    while more := {process for process, parent in parents.items() if parent in found} - found:
        found |= more
    return found
