"""The main function of a worker process.

It reads requests from its standard input and answers on its standard output, one JSON object per line: first
`{"ready": true}`, then for each request `{"started": true}` and the outcome, both with the `nonce` of the request and
the key of its unit. When its input ends, it ends at once with all processes that its units started, because then nobody
reads the result. Processes that its units fork have neither its input nor its output.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading
from functools import partial
from typing import Any, BinaryIO

from pano_mvs.engine.executors.started_processes import MARK, adopt_orphans, end_started


def main() -> None:
    """Serve requests until the input ends."""
    requests_in, answers_out = _take_streams()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles interrupts
    adopt_orphans()
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(requests_in, requests, os.environ.get(MARK, "")), daemon=True).start()
    from pano_mvs.engine.executors.worker_requests import run_request  # after the streams, because imports may print

    _answer(answers_out, {"ready": True})
    while True:
        request = json.loads(requests.get())
        whose = {"nonce": request["nonce"], "key": request["unit"]["key"]}
        _answer(answers_out, {**whose, "started": True})
        _answer(answers_out, {**whose, "outcome": run_request(request).to_json()})


def _take_streams() -> tuple[BinaryIO, BinaryIO]:
    """Reserve the standard streams for requests: stages print to the error stream and read nothing."""
    requests_in, answers_out = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=partial(_close, requests_in.fileno(), answers_out.fileno()))
    return requests_in, answers_out


def _close(*descriptors: int) -> None:
    for descriptor in descriptors:
        os.close(descriptor)


def _read(requests_in: BinaryIO, requests: queue.SimpleQueue[bytes], mark: str) -> None:
    for line in requests_in:
        requests.put(line)
    if os.name == "posix" and os.getpgrp() == os.getpid():
        end_started(os.getpid(), mark)
    os._exit(0)


def _answer(answers_out: BinaryIO, value: dict[str, Any]) -> None:
    answers_out.write(json.dumps(value).encode() + b"\n")
    answers_out.flush()
