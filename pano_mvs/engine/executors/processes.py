"""Compute units in parallel, in worker processes of this host."""

from __future__ import annotations

import queue
import threading
import time
import uuid
from dataclasses import replace
from typing import Any

from pano_mvs.core.files import temporary_prefix
from pano_mvs.core.memory import free_memory_bytes
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.protocol import Job, JobOutcome
from pano_mvs.engine.executors.unit_json import request_to_json
from pano_mvs.engine.executors.worker_process import WorkerProcess

UNITS_PER_PROCESS = 500
"""A worker is replaced after this many units, so that memory leaks of libraries do not add up."""

_MAX_FAILED_STARTS = 3
_LISTEN_S = 0.5  # some systems notice interrupts only between waits


class ProcessExecutor:
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

    def submit(self, job: Job) -> None:
        """Submit a job; another worker is started if all are busy."""
        request = request_to_json(job, self._store)
        if len(self._out) == len(self._workers):
            self._add_worker()
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

    def free_memory_bytes(self) -> int:
        """Return the free memory of this host."""
        return free_memory_bytes()

    def cancel(self) -> None:
        """End the processes of all jobs; later jobs get new ones."""
        self._out.clear()
        while not self._jobs.empty():
            self._jobs.get()
        for _, worker in self._workers:
            worker.kill()

    def close(self) -> None:
        """End all processes."""
        self._closing = True
        if self._out:
            self.cancel()
        for _ in self._workers:
            self._jobs.put(None)
        for thread, _ in self._workers:
            thread.join()
        self._workers.clear()

    def _add_worker(self) -> None:
        errors = self._store.blobs.temporary / f"{temporary_prefix()}worker-{uuid.uuid4().hex}.txt"
        try:
            errors.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._store.cannot_write(error) from error
        worker = WorkerProcess(self.cores, errors)
        thread = threading.Thread(target=self._serve, args=(worker,), daemon=True)
        self._workers.append((thread, worker))
        thread.start()

    def _serve(self, worker: WorkerProcess) -> None:
        """Pass units to one worker until there are no more, and restart it after `units_per_process` units."""
        while (taken := self._jobs.get()) is not None and not self._closing:
            job, request = taken
            try:
                outcome = worker.run(request)
            except OSError as error:  # not the fault of the unit
                outcome = JobOutcome(
                    "stopped",
                    cause=f"a worker cannot be started: {error}. Fix this and run the same command again",
                    error="StoreError",
                    exit_code=4,
                )
            self._ended.put((job.number, self._judged(outcome, refused=worker.refused)))
            if worker.served >= self._units_per_process:
                worker.stop()
        worker.stop()

    def _judged(self, outcome: JobOutcome, *, refused: bool) -> JobOutcome:
        """Return the outcome, with status `stopped` if several workers in a row ended while starting."""
        self._failed_starts = self._failed_starts + 1 if refused else 0
        if self._failed_starts < _MAX_FAILED_STARTS:
            return outcome
        return replace(outcome, status="stopped", cause=f"workers do not start: {outcome.cause}", error="PanoMvsError")
