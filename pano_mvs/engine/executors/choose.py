"""Make the executor that the command line asks for."""

from __future__ import annotations

import os
from pathlib import Path

from pano_mvs.core.errors import UsageError
from pano_mvs.core.memory import free_memory_bytes
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.execute import unit_outcome
from pano_mvs.engine.executors.processes import ProcessExecutor
from pano_mvs.engine.executors.protocol import Executor, Job, JobOutcome
from pano_mvs.engine.executors.queues import SYSTEMS, QueueExecutor, read_queue
from pano_mvs.engine.executors.threads import WORKER_BYTES, available_threads, share_cores


class SerialExecutor(Executor):
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

    def cancel(self) -> None:
        """Forget the job."""
        self._jobs.clear()

    def close(self) -> None:
        """Do nothing."""


VARIABLE = "PANO_MVS_EXECUTOR"
EXECUTORS = ("serial", "processes", "dask", *SYSTEMS)


def make_executor(
    store: Store, name: str = "", *, workers: int = 0, threads: int = 0, scheduler: str = "", queue: Path | None = None
) -> Executor:
    """Return an executor; the caller closes it.

    Args:
        name: of the executor; by default dask if a scheduler is given, else $PANO_MVS_EXECUTOR (unless a number of
            workers is given), else processes.
        workers: number of units at a time; 0 for as many as cores and memory (3 GB each) allow.
        threads: threads of each worker; 0 for an equal share of the cores.
        scheduler: address of a dask scheduler; without one, dask starts a cluster on this host.
        queue: file with the settings of the jobs, for a queueing system.

    Raises:
        UsageError: if the arguments contradict each other, or the executor is not installed or cannot be reached.
    """
    name = name or ("dask" if scheduler else "" if workers else os.environ.get(VARIABLE, "")) or "processes"
    if name not in EXECUTORS:
        raise UsageError(f"there is no executor {name!r}; choose one of {', '.join(EXECUTORS)}")
    if scheduler and name != "dask":
        raise UsageError(f"--scheduler requires --executor dask; {name} has no scheduler")
    if queue is not None and name not in SYSTEMS:
        raise UsageError(f"--queue requires --executor slurm, pbs, lsf or sge; {name} has no jobs")
    if name in SYSTEMS:
        if queue is None:
            raise UsageError(f"--executor {name} requires --queue FILE.yaml; docs/running.md shows such a file")
        if workers:
            raise UsageError(f"--workers has no effect with --executor {name}: set `jobs` in {queue}")
        return QueueExecutor(store, name, read_queue(queue), threads=threads)
    if name == "serial":
        if workers > 1:
            raise UsageError("--executor serial runs one unit at a time; for more use --executor processes")
        return SerialExecutor(store, threads=threads)
    workers, threads = shape(workers, threads)
    if name == "processes":
        return ProcessExecutor(store, workers=workers, threads=threads)
    from pano_mvs.engine.executors.dask_cluster import DaskExecutor

    return DaskExecutor(store, workers=workers, threads=threads, scheduler=scheduler)


def shape(workers: int = 0, threads: int = 0) -> tuple[int, int]:
    """Return the number of workers on this host and the threads of each, as `make_executor` chooses them.

    Raises:
        UsageError: if there are not enough cores.
    """
    cores = available_threads()
    if not workers and not threads:
        workers = max(1, min(cores, free_memory_bytes() // WORKER_BYTES or cores))
    return share_cores(cores, workers=workers, threads=threads)
