"""One worker process, seen from the main process.

Each worker has its own pipes, so that it can die at any moment without affecting others. (In the pools of the standard
library and of pebble all workers share one pipe with one lock, and a worker that is killed while it holds the lock
blocks the others.) Workers are new processes, not forks, so that they inherit no threads, locks or open files.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pano_mvs.engine.executors.capture import tail
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.executors.threads import bound_environment

_BOOT = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from pano_mvs.engine.executors.worker import main; main()"
)
_STOP_S = 5.0
_LISTEN_S = 0.5


class WorkerProcess:
    """A process that computes one unit at a time; it is started for the first one.

    Attributes:
        served: number of units that the present process has received.
        refused: whether the latest process exited by itself before it was ready for a unit.
    """

    def __init__(self, threads: int, errors: Path) -> None:
        """Prepare a worker.

        Args:
            threads: the most threads that a unit may use.
            errors: file for what the process prints outside units, such as why it cannot start.
        """
        self.threads = threads
        self.errors = errors
        self.served = 0
        self.refused = False
        self._ready = False
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._process: subprocess.Popen[bytes] | None = None
        self._too_late = False

    def run(self, request: Mapping[str, Any]) -> JobOutcome:
        """Compute a unit and wait for it; if the process dies or takes too long, only this unit fails."""
        if request["fresh"] and self.served:
            self.stop()
        process = self._process or self._start()
        self.served += 1
        whose = {"nonce": uuid.uuid4().hex, "key": request["unit"]["key"]}
        timeout_s = float(request["timeout_s"])
        timer = threading.Timer(timeout_s, self._end_late) if timeout_s else None
        try:
            assert process.stdin is not None
            process.stdin.write(json.dumps({**request, "nonce": whose["nonce"]}).encode() + b"\n")
            process.stdin.flush()
            outcome = self._listen(process, whose, timer)
        except OSError:
            outcome = None
        if timer is not None:
            timer.cancel()
        if outcome is None:
            return self._death(process, timeout_s)
        # It finished just when it was being ended, or nothing else may be computed after it.
        if self._too_late or outcome.died or request["fresh"]:
            self.stop()
        return outcome

    def stop(self) -> None:
        """End the process, which is idle."""
        process, self._process = self._process, None
        if process is not None:
            _close(process)
        with suppress(OSError):  # it stays if the cache cannot be written any more
            self.errors.unlink(missing_ok=True)

    def kill(self) -> None:
        """End the process and those that its unit started at once, from any thread."""
        process = self._process
        if process is not None:
            _kill(process)

    def _start(self) -> subprocess.Popen[bytes]:
        environment = dict(os.environ)
        bound_environment(environment, self.threads)
        path = json.dumps([place for place in sys.path if place])  # "" would mean the current folder
        self.served, self.refused, self._ready, self._too_late = 0, False, False, False
        with self.errors.open("wb") as errors:
            self._process = subprocess.Popen(  # noqa: S603 (our own code)
                [sys.executable, "-P", "-X", "faulthandler", "-c", _BOOT, path],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env=environment,
                # Ctrl-C in a terminal reaches a whole process group; only the main process should get it.
                start_new_session=os.name == "posix",
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )
        self._lines = queue.SimpleQueue()
        threading.Thread(target=_read_lines, args=(self._process, self._lines), daemon=True).start()
        return self._process

    def _listen(
        self, process: subprocess.Popen[bytes], whose: Mapping[str, str], timer: threading.Timer | None
    ) -> JobOutcome | None:
        """Return the outcome from the worker, or None if it dies first, even if others hold its output open."""
        while (line := self._next_line(process)) is not None:
            answer = json.loads(line)
            self._ready = True
            if {name: answer.get(name) for name in whose} != whose:
                continue  # it is ready, or another process answered an earlier request
            if "outcome" in answer:
                return JobOutcome.from_json(answer["outcome"])
            if timer is not None:
                timer.start()
        return None

    def _next_line(self, process: subprocess.Popen[bytes]) -> bytes | None:
        while True:
            try:
                return self._lines.get(timeout=_LISTEN_S)
            except queue.Empty:
                if process.poll() is not None:
                    return None

    def _end_late(self) -> None:
        self._too_late = True
        self.kill()

    def _death(self, process: subprocess.Popen[bytes], timeout_s: float) -> JobOutcome:
        self._process = None
        _close(process)
        if self._too_late:
            return JobOutcome(
                "failed", cause=f"it took longer than timeout_s: {timeout_s:g}, and was ended", error="Timeout"
            )
        self.refused = not self._ready and process.returncode >= 0
        said = () if self._ready else tail(self.errors, 3)
        cause = f"its worker process died ({_how(process.returncode)})" + "".join(f"\n  {line}" for line in said)
        return JobOutcome("failed", cause=cause, died=True)


def _read_lines(process: subprocess.Popen[bytes], lines: queue.SimpleQueue[bytes | None]) -> None:
    """Pass on the lines that a process writes, and None at the end, until nobody holds its output open."""
    assert process.stdout is not None
    with process.stdout as stream:
        for line in stream:
            lines.put(line if line.endswith(b"\n") else None)
    lines.put(None)


def _close(process: subprocess.Popen[bytes]) -> None:
    """Close the input of a process, which ends it, and wait for that; end it and what it started in any case."""
    with suppress(OSError):  # unsent data is not needed any more
        if process.stdin is not None:
            process.stdin.close()
    with suppress(subprocess.TimeoutExpired):
        process.wait(_STOP_S)
    _kill(process)
    process.wait()


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process and all processes of its group, which may outlive it."""
    if os.name != "posix":
        process.kill()
        return
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    name = signal.Signals(-code).name if -code in {number.value for number in signal.Signals} else f"signal {-code}"
    want = ", as the system does when memory runs out: declare `memory:` or use fewer --workers"
    return f"killed by {name}{want if name == 'SIGKILL' else ''}"
