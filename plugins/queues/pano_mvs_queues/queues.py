"""Compute units in jobs of a queueing system: SLURM, PBS, LSF or SGE, by dask-jobqueue.

The dask scheduler runs in the process of the command. Each job runs one dask worker, which computes several units at a
time. Jobs are submitted while units wait, and ended when they have been idle for a minute. If a job is lost, its units
are computed by others, and another job is submitted.
"""

from __future__ import annotations

import asyncio
import importlib
import re
import shutil
import signal
import threading
import time
import uuid
from pathlib import Path
from typing import Any

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError, field_validator

from pano_mvs.core.errors import UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.files import remove_whole, temporary_prefix
from pano_mvs.core.memory import bytes_from_size
from pano_mvs.core.yaml_text import Problems, parse_yaml, report_invalid
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.protocol import Job
from pano_mvs.engine.executors.threads import WORKER_BYTES, share_cores
from pano_mvs.engine.workflows.workflow_file import read_text
from pano_mvs_queues.dask_cluster import NO_DASHBOARD, DaskExecutor, with_waiting

SYSTEMS = {"slurm": "sbatch", "pbs": "qsub", "lsf": "bsub", "sge": "qsub"}
"""Queueing system to its command that submits a job."""

_ACCOUNTS = {"slurm": "account", "pbs": "account", "lsf": "project", "sge": "project"}
_RETRY_S = 60.0
_WALLTIME = re.compile(r"\d+([-:]\d+)*")


class Queue(BaseModel):
    """The jobs of a queueing system."""

    model_config = ConfigDict(frozen=True, extra="forbid", coerce_numbers_to_str=True)

    cores: int = Field(ge=1)
    memory: str | int  # of a job, such as `32GB`
    walltime: str  # time limit of a job, as the queueing system writes it, such as `04:00:00`
    jobs: int = Field(ge=1)  # largest number of jobs at a time
    # queue or partition; None for the default one
    queue: str | None = Field(default=None, validation_alias=AliasChoices("queue", "partition"))
    # account or project that is charged; None for the default one
    account: str | None = Field(default=None, validation_alias=AliasChoices("account", "project"))
    # network interface by which jobs reach this host, such as `ib0`; None for the default one
    interface: str | None = None
    directives: tuple[str, ...] = ()  # further options of a job, such as `--qos=low`
    prologue: tuple[str, ...] = ()  # shell commands with which a job begins

    @field_validator("memory")
    @classmethod
    def _is_size(cls, memory: str | int) -> str | int:
        bytes_from_size(memory)
        return memory

    @field_validator("walltime")
    @classmethod
    def _is_time(cls, walltime: str) -> str:
        if not _WALLTIME.fullmatch(walltime):
            raise ValueError("must be a time such as 04:00:00")
        return walltime

    @property
    def memory_bytes(self) -> int:
        """Memory of a job."""
        return bytes_from_size(self.memory)

    def shape(self, threads: int = 0) -> tuple[int, int]:
        """Return the number of units at a time in a job, and the threads of each; 0 for an equal share of the cores."""
        places = 0 if threads else max(1, min(self.cores, self.memory_bytes // WORKER_BYTES))
        return share_cores(self.cores, workers=places, threads=threads)


def read_queue(path: Path) -> Queue:
    """Read the settings of the jobs from a YAML file.

    Raises:
        InputError: if the file cannot be read.
        WorkflowError: with every error and its location.
    """
    problems = Problems()
    root = parse_yaml(read_text(path, "queue file"), str(path), problems)
    if not isinstance(root.value, dict):
        problems.add(root.place, f"must be a mapping with the keys {', '.join(Queue.model_fields)}")
    else:
        try:
            queue = Queue.model_validate(root.plain())
        except ValidationError as error:
            report_invalid(error, root, problems, model=Queue, also=("partition", "project"))
    problems.raise_if_any()
    return queue


def job_settings(system: str, queue: Queue, *, places: int, logs: Path) -> dict[str, Any]:
    """Return the arguments of a cluster of dask-jobqueue that describe its jobs.

    Args:
        places: number of units at a time in a job.
        logs: folder for what the jobs print; all hosts see it.
    """
    # Limits of the submitting host must not reach the jobs, whose environment may be a copy.
    limits = [f"export {name}={queue.cores}" for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")]
    return {
        "queue": queue.queue,
        _ACCOUNTS[system]: queue.account,
        "walltime": queue.walltime,
        "cores": queue.cores,
        "memory": f"{queue.memory_bytes}B",
        "processes": 1,
        # The last --nthreads counts: dask-jobqueue has no setting for fewer units than cores.
        "worker_extra_args": ["--nthreads", f"{places}", "--resources", f"memory={queue.memory_bytes}"],
        "job_name": "pano-mvs",
        "job_extra_directives": list(queue.directives),
        "job_script_prologue": [*limits, *queue.prologue],
        "interface": queue.interface,
        "log_directory": str(logs.absolute()),
    }


def cluster_class(system: str) -> Any:
    """Return the class of dask-jobqueue for a queueing system.

    Raises:
        UsageError: if dask-jobqueue is not installed, or the queueing system is not on this host.
    """
    handler = signal.getsignal(signal.SIGINT)
    import_extra("cryptography", f"--executor {system}", "queues")
    library = import_extra("dask_jobqueue", f"--executor {system}", "queues")
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)  # the import has replaced it
    if shutil.which(SYSTEMS[system]) is None:
        raise UsageError(
            f"--executor {system}: there is no command {SYSTEMS[system]} on the PATH. Run this where you submit jobs, "
            "such as on the login node of the cluster"
        )
    return getattr(library, f"{system.upper()}Cluster")


def patient(base: Any) -> Any:
    """Return a class of jobs that are submitted again later if the queueing system refuses them.

    A class of dask-jobqueue raises an error where nobody receives it, and never submits the job again. This one enters
    why the system refuses a job into its attribute `refusals`.
    """
    status = importlib.import_module("distributed").Status
    refusals: list[str] = []

    async def start(self: Any) -> None:
        try:
            await base.start(self)
        except (RuntimeError, ValueError, OSError) as error:
            lines = [line.strip() for line in str(error).split("stderr:")[-1].splitlines()]
            refusals.append(" ".join(line for line in lines if line))
            self.status = status.running
            # The cluster submits the jobs that it plans and does not have.
            asyncio.get_running_loop().call_later(_RETRY_S, lambda: self._cluster().workers.pop(self.name, None))

    async def close(self: Any) -> None:
        await base.close(self)
        self.status = status.closed

    return type("QueueJob", (base,), {"start": start, "close": close, "refusals": refusals})


class QueueExecutor(DaskExecutor):
    """Submits jobs of a queueing system, and units to the dask workers that run in them."""

    def __init__(self, store: Store, system: str, queue: Queue, *, threads: int = 0) -> None:
        """Prepare; the first unit submits the first job.

        Args:
            store: the cache, in a folder with the same path on all hosts.
            threads: threads for a unit; 0 for an equal share of the cores.

        Raises:
            UsageError: if dask-jobqueue is not installed, the queueing system is not on this host, or jobs could not
                reach this host.
        """
        self.name, self._store = system, store
        places, self.threads = queue.shape(threads)
        self.capacity = with_waiting(places * queue.jobs)
        self.cores = max(queue.cores, self.threads)
        self._queue = queue
        self._is_started = False
        self._had_workers_at = 0.0
        self._logs = store.root / "jobs"
        self._keys = store.blobs.temporary.absolute() / f"{temporary_prefix()}keys-{uuid.uuid4().hex}"
        kind = cluster_class(system)
        try:
            self._connect(store, self._cluster_of(kind, job_settings(system, queue, places=places, logs=self._logs)))
        except BaseException:
            remove_whole(self._keys)
            raise

    def _cluster_of(self, kind: Any, settings: dict[str, Any]) -> Any:
        """Return a cluster whose scheduler has been started in this process."""
        distributed = importlib.import_module("distributed")
        options = importlib.import_module("dask").config.get(f"jobqueue.{self.name}.scheduler-options", {})
        try:
            # Encrypted, with new keys that only this user can read: otherwise anyone who can reach a port of this host
            # could run code as this user.
            self._keys.mkdir(mode=0o700, parents=True)
            for name, text in distributed.Security.temporary().get_tls_config_for_role("worker").items():
                if text:
                    (self._keys / name).touch(mode=0o600)
                    (self._keys / name).write_text(text, encoding="ascii")
        except OSError as error:
            raise self._store.cannot_write(error) from error
        roles = [f"{role}_{name}" for role in ("client", "scheduler", "worker") for name in ("cert", "key")]
        files = {f"tls_{name}": str(self._keys / name.partition("_")[2]) for name in roles}
        security = distributed.Security(require_encryption=True, tls_ca_file=str(self._keys / "ca_file"), **files)
        try:
            return kind(
                job_cls=patient(kind.job_cls),
                security=security,
                scheduler_options={**NO_DASHBOARD, **options},
                **settings,
            )
        except (RuntimeError, ValueError, OSError) as error:
            raise UsageError(
                f"--executor {self.name}: jobs could not reach this host: {error}. Check `interface` in the file of "
                "--queue: it must be a network interface of this host that the jobs can reach"
            ) from error

    def submit(self, job: Job) -> None:
        """Submit a unit, and the first job.

        Raises:
            UsageError: if the queueing system refuses the job.
        """
        if not self._is_started:
            self._start()
        super().submit(job)

    def free_memory_bytes(self) -> int:
        """Return the memory of all jobs."""
        return self._queue.memory_bytes * self._queue.jobs

    def notice(self) -> str:
        """Return why a job was refused, or that no job has connected for a minute; each once."""
        if self._refusals:
            text = self._refusals[-1]
            self._refusals.clear()
            return f"{self.name} refused a job, which is submitted again in a minute: {text}"
        now = time.monotonic()
        if not self._is_started or self.places():
            self._had_workers_at = now
        if now - self._had_workers_at < 60.0:
            return ""
        self._had_workers_at = float("inf")
        return (
            f"no job of {self.name} has connected for a minute: the queue shows whether they wait, and what they "
            f"print is in {self._logs}"
        )

    def _start(self) -> None:
        cluster: Any = self._cluster
        cluster.scale(jobs=1)
        cluster.sync(_submitted, cluster)
        if self._refusals:
            raise UsageError(f"--executor {self.name}: it refused the first job: {self._refusals[0]}")
        # Each waiting unit asks for a job.
        cluster.adapt(maximum_jobs=self._queue.jobs, interval="1s", wait_count=60, target_duration="1ms")  # 60 s
        self._is_started, self._had_workers_at = True, time.monotonic()

    @property
    def _refusals(self) -> list[str]:
        cluster: Any = self._cluster
        refusals: list[str] = cluster.job_cls.refusals
        return refusals

    def close(self) -> None:
        """End the jobs."""
        super().close()
        remove_whole(self._keys)

    def _resources(self, job: Job) -> dict[str, float] | None:
        """Return the memory of a unit, so that the units of a job fit into it."""
        return {"memory": min(job.memory_bytes, self._queue.memory_bytes)} if job.memory_bytes else None


async def _submitted(cluster: Any) -> None:
    await cluster
