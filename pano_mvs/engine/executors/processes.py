"""Compute units in parallel, in worker processes of this host."""

from __future__ import annotations

import json
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from pano_mvs.core.files import make_folder, temporary_prefix
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.capture import tail
from pano_mvs.engine.executors.fork_server import ForkedProcess, ForkServer
from pano_mvs.engine.executors.protocol import Executor, Job, JobOutcome
from pano_mvs.engine.executors.threads import bound_environment
from pano_mvs.engine.executors.unit_requests import request_to_json
from pano_mvs.engine.executors.worker import MARK, end_started

UNITS_PER_PROCESS = 500
"""A worker is replaced after this many units, so that memory leaks of libraries do not add up."""

Process: TypeAlias = subprocess.Popen[bytes] | ForkedProcess
_LISTEN_S = 0.5  # some systems notice interrupts only between waits


class ProcessExecutor(Executor):
    """A pool of long-lived workers, started as needed, each served by a thread."""

    name = "processes"
    enforces_timeouts = True

    def __init__(self, store: Store, *, workers: int, threads: int, units_per_process: int = UNITS_PER_PROCESS) -> None:
        self.capacity = workers
        self.threads = threads
        self.cores = workers * threads
        self._store = store
        self._units_per_process = units_per_process
        self._jobs: queue.SimpleQueue[tuple[Job, dict[str, Any]] | None] = queue.SimpleQueue()
        self._ended: queue.SimpleQueue[tuple[int, JobOutcome]] = queue.SimpleQueue()
        self._out: set[int] = set()
        self._workers: list[tuple[threading.Thread, WorkerProcess]] = []
        self._failed_starts = 0
        self._closing = False
        self._forks = ForkServer(self.cores)

    def submit(self, job: Job) -> None:
        """Submit a job; another worker is started if all are busy."""
        request = request_to_json(job, self._store)
        if len(self._out) == len(self._workers):
            errors = self._store.blobs.temporary / f"{temporary_prefix()}worker-{uuid.uuid4().hex}.txt"
            try:
                make_folder(errors.parent)
            except OSError as error:
                raise self._store.cannot_write(error) from error
            worker = WorkerProcess(self.cores, errors, units=self._units_per_process, forks=self._forks)
            thread = threading.Thread(target=self._serve, args=(worker,), daemon=True)
            self._workers.append((thread, worker))
            thread.start()
        self._out.add(job.number)
        self._jobs.put((job, request))

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        """Return the number and the outcome of a job that has ended; see `Executor`."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while self._out:
            left = _LISTEN_S if deadline is None else deadline - time.monotonic()
            try:
                number, outcome = (
                    self._ended.get(timeout=min(left, _LISTEN_S)) if left > 0 else self._ended.get_nowait()
                )
            except queue.Empty:
                if left <= 0:
                    return None
                continue
            if number in self._out:
                self._out.remove(number)
                return number, outcome
        return None

    def cancel(self) -> None:
        """End the processes of all jobs; later jobs get new ones."""
        self._out.clear()
        with suppress(queue.Empty):  # the threads take jobs meanwhile
            while True:
                self._jobs.get_nowait()
        for _, worker in self._workers:
            worker.kill()

    def close(self) -> None:
        """End all processes."""
        self._closing = True
        if self._out:
            self.cancel()
            self._forks.close()  # or a worker that is being started would be waited for
        for _ in self._workers:
            self._jobs.put(None)
        for thread, worker in self._workers:
            thread.join(_LISTEN_S)
            while thread.is_alive():  # its process may have started just when all were ended
                worker.kill()
                thread.join(_LISTEN_S)
        self._workers.clear()
        self._forks.close()

    def _serve(self, worker: WorkerProcess) -> None:
        """Pass units to one worker until there are no more."""
        while (taken := self._jobs.get()) is not None and not self._closing:
            job, request = taken
            try:
                outcome = worker.run(request)
            except (OSError, RuntimeError, MemoryError) as error:  # not the fault of the unit
                outcome = JobOutcome(
                    "stopped",
                    cause=f"a worker cannot be started: {error}. Fix this and run the same command again",
                    error="StoreError",
                    exit_code=4,
                )
            except Exception as error:  # whatever it is, the run must not wait for this unit for ever
                worker.kill()
                trace = "".join(traceback.format_exception(error))
                outcome = JobOutcome("failed", cause=f"it could not be passed to a worker: {error!r}", trace=trace)
            self._failed_starts = self._failed_starts + 1 if worker.refused else 0
            if self._failed_starts >= 3:  # several workers in a row ended while starting
                cause = f"workers do not start: {outcome.cause}"
                outcome = replace(outcome, status="stopped", cause=cause, error="PanoMvsError")
            self._ended.put((job.number, outcome))
        worker.stop()


_BOOT = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from pano_mvs.engine.executors.worker import main; main()"
)
_BOOT_THERE = "from pano_mvs.engine.executors.worker import main; main()"


class WorkerProcess:
    """A process that computes one unit at a time; it is started for the first one."""

    def __init__(
        self,
        threads: int,
        errors: Path,
        *,
        units: int = UNITS_PER_PROCESS,
        forks: ForkServer | None = None,
        python: Sequence[str] = (),
        variables: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Prepare a worker.

        Args:
            threads: the most threads that a unit may use.
            errors: file for what the process prints outside units, such as why it cannot start.
            units: the most units of one process; the next unit gets another one.
            forks: forks the process, if it can.
            python: another interpreter with its options, in which pano_mvs is installed; by default this one, with
                the same path.
            variables: what is different in the environment of the process.
        """
        self._units = units
        self._forks = forks
        self._python = tuple(python)
        self._variables = variables
        self.threads = threads
        self.errors = errors
        self.served = 0  # number of units that the present process has received
        self.refused = False  # whether the latest process exited by itself before it was ready for a unit
        self._ready = False
        self._lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._process: Process | None = None
        self._too_late = False
        self._left_s = math.inf
        self._mark = uuid.uuid4().hex

    def run(self, request: Mapping[str, Any]) -> JobOutcome:
        """Compute a unit and wait for it; if the process dies or takes too long, only this unit fails."""
        if self.served >= (1 if request["fresh"] else self._units):
            self.stop()
        process = self._process or self._start()
        self.served += 1
        whose = {"nonce": uuid.uuid4().hex, "key": request["unit"]["key"]}
        timeout_s = float(request["timeout_s"])
        self._left_s = math.inf
        try:
            assert process.stdin is not None
            process.stdin.write(json.dumps({**request, "nonce": whose["nonce"]}).encode() + b"\n")
            process.stdin.flush()
            outcome = self._listen(process, whose, timeout_s or math.inf)
        except OSError:
            outcome = None
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
            _close(process, self._mark)
        with suppress(OSError):  # it stays if the cache cannot be written any more
            self.errors.unlink(missing_ok=True)

    def kill(self) -> None:
        """End the process and those that its unit started at once, from any thread."""
        process = self._process
        if process is not None:
            _kill(process, self._mark)

    def _start(self) -> Process:
        self._mark = uuid.uuid4().hex
        self.served, self.refused, self._ready, self._too_late = 0, False, False, False
        forked = self._forks.fork(self._mark, self.errors) if self._forks is not None else None
        self._process = forked or self._popen()
        self._lines = queue.SimpleQueue()
        threading.Thread(target=_read_lines, args=(self._process, self._lines), daemon=True).start()
        return self._process

    def _popen(self) -> subprocess.Popen[bytes]:
        environment = {**os.environ, **self._variables, MARK: self._mark}
        bound_environment(environment, self.threads)
        path = json.dumps([place for place in sys.path if place])  # "" would mean the current folder
        same = [sys.executable, "-P", "-X", "faulthandler", "-c", _BOOT, path]
        command = [*self._python, "-X", "faulthandler", "-c", _BOOT_THERE] if self._python else same
        with self.errors.open("wb") as errors:
            return subprocess.Popen(  # noqa: S603 (our own code)
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env=environment,
                # Ctrl-C in a terminal reaches a whole process group; only the main process should get it.
                start_new_session=os.name == "posix",
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )

    def _listen(self, process: Process, whose: Mapping[str, str], timeout_s: float) -> JobOutcome | None:
        """Return the outcome from the worker, or None if it dies first, even if others hold its output open."""
        while (line := self._next_line(process)) is not None:
            try:
                answer = json.loads(line)
                self._ready = True
                if {name: answer.get(name) for name in whose} != whose:
                    continue  # it is ready, or another process answered an earlier request
                if "outcome" in answer:
                    return JobOutcome.from_json(answer["outcome"])
            except Exception as error:  # the stage has written into our pipe
                cause = f"its worker process gave an answer that cannot be read ({type(error).__name__}: {error})"
                return JobOutcome("failed", cause=cause, died=True)
            self._left_s = timeout_s
        return None

    def _next_line(self, process: Process) -> bytes | None:
        """Return the next line from the worker, which is ended when its time is over; None if it has ended.

        The time is that in which this process waits: a clock would go on while both processes are stopped.
        """
        while True:
            wait_s = min(_LISTEN_S, self._left_s)
            try:
                return self._lines.get(timeout=wait_s)
            except queue.Empty:
                if process.poll() is not None:
                    return None
            self._left_s -= wait_s
            if self._left_s <= 0:
                self._too_late, self._left_s = True, math.inf
                self.kill()

    def _death(self, process: Process, timeout_s: float) -> JobOutcome:
        self._process = None
        status = _close(process, self._mark)
        if self._too_late:
            return JobOutcome(
                "failed", cause=f"it took longer than timeout_s: {timeout_s:g}, and was ended", error="Timeout"
            )
        self.refused = not self._ready and status >= 0
        said = () if self._ready else tail(self.errors, 3)
        cause = f"its worker process died ({_how(status)})" + "".join(f"\n  {line}" for line in said)
        return JobOutcome("failed", cause=cause, died=True)


def _read_lines(process: Process, lines: queue.SimpleQueue[bytes | None]) -> None:
    """Pass on the lines that a process writes, and None at the end, until nobody holds its output open."""
    assert process.stdout is not None
    try:
        with process.stdout as stream:
            for line in stream:
                lines.put(line if line.endswith(b"\n") else None)
    finally:  # also if a line does not fit into memory
        lines.put(None)


def _close(process: Process, mark: str) -> int:
    """Close the input of a process, which ends it, and return its exit status; end it and what it started anyway."""
    with suppress(OSError):  # unsent data is not needed any more
        if process.stdin is not None:
            process.stdin.close()
    with suppress(subprocess.TimeoutExpired):
        process.wait(5.0)
    _kill(process, mark)
    return process.wait()


def _kill(process: Process, mark: str) -> None:
    """End a process and all that it started, which may outlive it."""
    if os.name != "posix":
        process.kill()
        return
    end_started(process.pid, mark)


def _how(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    name = signal.Signals(-code).name if -code in {number.value for number in signal.Signals} else f"signal {-code}"
    want = ", as the system does when memory runs out: declare `memory:` or use fewer --workers"
    return f"killed by {name}{want if name == 'SIGKILL' else ''}"
