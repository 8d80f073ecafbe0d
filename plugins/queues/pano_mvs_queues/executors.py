"""The executors dask, slurm, pbs, lsf and sge, and their options."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pano_mvs.core.doors import RunOption
from pano_mvs.core.errors import UsageError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import ExecutorKind, ExecutorRequest, ExecutorSize, shape, size_of_host
from pano_mvs.engine.executors.protocol import Executor

_SCHEDULER = RunOption(
    "scheduler", "Use this dask scheduler, such as tcp://host:8786; its workers must share the cache.", "ADDRESS"
)
_QUEUE = RunOption(
    "queue", "Settings of the jobs of slurm, pbs, lsf or sge: cores, memory, walltime, number of jobs, queue.", "FILE"
)


def _dask(store: Store, request: ExecutorRequest) -> Executor:
    from pano_mvs_queues.dask_cluster import DaskExecutor

    workers, threads = shape(request.workers, request.threads)
    return DaskExecutor(store, workers=workers, threads=threads, scheduler=request.options.get("scheduler", ""))


def _size_of_dask(request: ExecutorRequest) -> ExecutorSize:
    size = size_of_host(request)
    return replace(size, memory_bytes=0) if request.options.get("scheduler") else size


def _jobs(store: Store, request: ExecutorRequest) -> Executor:
    from pano_mvs_queues.queues import QueueExecutor, read_queue

    return QueueExecutor(store, request.name, read_queue(_file(request)), threads=request.threads)


def _size_of_jobs(request: ExecutorRequest) -> ExecutorSize:
    from pano_mvs_queues.queues import read_queue

    queue = read_queue(_file(request))
    places, threads = queue.shape(request.threads)
    return ExecutorSize(places * queue.jobs, threads, queue.memory_bytes)


def _file(request: ExecutorRequest) -> Path:
    """Return the file with the settings of the jobs."""
    if not request.options.get("queue"):
        raise UsageError(f"--executor {request.name} requires --queue FILE.yaml; docs/running.md shows such a file")
    file = Path(request.options["queue"])
    if request.workers:
        raise UsageError(f"--workers has no effect with --executor {request.name}: set `jobs` in {file}")
    return file


dask = ExecutorKind(_dask, (_SCHEDULER,), _size_of_dask)
jobs = ExecutorKind(_jobs, (_QUEUE,), _size_of_jobs)
