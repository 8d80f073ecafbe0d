"""Compute one unit after another in this process: nothing to start, and a debugger sees everything.

A unit is not isolated from the run: native code that crashes or exits ends both, and a unit that hangs cannot be ended.
"""

from __future__ import annotations

from pano_mvs.core.memory import free_memory_bytes
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.protocol import Job, JobOutcome
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.executors.unit_outcome import unit_outcome


class SerialExecutor:
    """Computes each job when `wait` is called."""

    name = "serial"
    capacity = 1
    enforces_timeouts = False

    def __init__(self, store: Store, *, threads: int = 0) -> None:
        self.threads = self.cores = threads or available_threads()
        self._store = store
        self._jobs: list[Job] = []

    def submit(self, job: Job) -> None:
        """Keep a job for `wait`."""
        self._jobs.append(job)

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        """Compute the submitted job; the timeout does not limit its time."""
        if not self._jobs or timeout_s == 0:
            return None
        job = self._jobs.pop(0)
        return job.number, unit_outcome(job.unit, self._store, threads=job.threads, log=job.log)

    def free_memory_bytes(self) -> int:
        """Return the free memory of this host."""
        return free_memory_bytes()

    def cancel(self) -> None:
        """Forget the job."""
        self._jobs.clear()

    def close(self) -> None:
        """Do nothing."""
