"""The main function of a worker process.

It reads requests from its standard input and answers on its standard output, one JSON object per line: first
`{"ready": true}`, then for each request `{"started": true}` and the outcome, both with the `nonce` of the request and
the key of its unit. When its input ends, it ends at once with all processes that its units started, because then nobody
reads the result. Processes that its units fork have neither its input nor its output.

All processes that a worker has started are ended with it, even those that have left its process group. On Linux, a
worker adopts its descendants whose own parents end, so that all of them are found below it in `/proc`. If the worker
itself has ended, they are found by a mark in the environment that they inherit.
"""

from __future__ import annotations

import ctypes
import json
import os
import queue
import signal
import sys
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from pano_mvs.core.paths import children

MARK = "PANO_MVS_WORKER"
"""Environment variable of a worker and of what it starts, whose value no other worker has."""


def main() -> None:
    """Serve requests until the input ends."""
    requests_in, answers_out = _take_streams()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles interrupts
    adopt_orphans()
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(requests_in, requests, os.environ.get(MARK, "")), daemon=True).start()
    from pano_mvs.engine.executors.unit_requests import run_request  # after the streams, because imports may print

    _answer(answers_out, {"ready": True})
    while True:
        request = json.loads(requests.get())
        whose = {"nonce": request["nonce"], "key": request["unit"]["key"]}
        _answer(answers_out, {**whose, "started": True})
        _answer(answers_out, {**whose, "outcome": run_request(request).to_json()})


def adopt_orphans() -> None:
    """Let this process, on Linux, be the parent of those below it whose own parents end."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER


def _take_streams() -> tuple[BinaryIO, BinaryIO]:
    """Reserve the standard streams for requests: stages print to the error stream and read nothing."""
    requests_in, answers_out = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    if hasattr(os, "register_at_fork"):
        for stream in (requests_in, answers_out):
            os.register_at_fork(after_in_child=partial(os.close, stream.fileno()))
    return requests_in, answers_out


def _read(requests_in: BinaryIO, requests: queue.SimpleQueue[bytes], mark: str) -> None:
    for line in requests_in:
        requests.put(line)
    if os.name == "posix" and os.getpgrp() == os.getpid():
        end_started(os.getpid(), mark)
    os._exit(0)


def _answer(answers_out: BinaryIO, value: dict[str, Any]) -> None:
    answers_out.write(json.dumps(value).encode() + b"\n")
    answers_out.flush()


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


def children_of(parent: int) -> set[int]:
    """Return the processes that a process has started or adopted; none on systems without `/proc`."""
    return {process for process, above in _parents().items() if above == parent}


def _started(worker: int, mark: str) -> set[int]:
    """Return the processes below a worker, and those that bear its mark."""
    parents = _parents()
    found = {worker}
    for process in parents:
        with suppress(OSError):  # it has ended, or belongs to another user
            if f"{MARK}={mark}".encode() in Path(f"/proc/{process}/environ").read_bytes().split(b"\0"):
                found.add(process)
    while more := {process for process, parent in parents.items() if parent in found} - found:
        found |= more
    return found


def _parents() -> dict[int, int]:
    parents = {}
    for folder in children(Path("/proc"), "[0-9]*"):
        with suppress(OSError):  # it has ended
            parents[int(folder.name)] = int((folder / "stat").read_bytes().rpartition(b")")[2].split()[1])
    return parents
