"""Make the executor that a run asks for: a built-in one, or one of a plugin."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from pano_mvs.core.doors import Door, RunOption
from pano_mvs.core.errors import PanoMvsError, PluginError, UsageError
from pano_mvs.core.memory import free_memory_bytes, total_memory_bytes
from pano_mvs.core.text import error_summary
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.execute import unit_outcome
from pano_mvs.engine.executors.processes import ProcessExecutor
from pano_mvs.engine.executors.protocol import Executor, Job, JobOutcome
from pano_mvs.engine.executors.threads import WORKER_BYTES, available_threads, share_cores
from pano_mvs.engine.stages.stage import RemoteStage


@dataclass(frozen=True, slots=True)
class ExecutorRequest:
    """What a run asks of its executor."""

    name: str = ""  # of the executor; one plugin may offer several that differ little
    workers: int = 0  # number of units at a time; 0 for as many as cores and memory (3 GB each) allow
    threads: int = 0  # threads of each worker; 0 for an equal share of the cores
    # the executor's own options, without the dashes, to their values; "" for a flag, the last of several values
    options: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ExecutorSize:
    """How much an executor computes at a time, as `pano-mvs plan` assumes it."""

    workers: int
    threads: int  # of each worker
    memory_bytes: int  # of one machine, for all units on it together; 0 if unknown


def size_of_host(request: ExecutorRequest) -> ExecutorSize:
    """Return the size of an executor on this host."""
    workers, threads = shape(request.workers, request.threads)
    return ExecutorSize(workers, threads, total_memory_bytes())


@dataclass(frozen=True, slots=True)
class ExecutorKind:
    """An executor that users choose by `--executor NAME`."""

    make: Callable[[Store, ExecutorRequest], Executor]  # the caller closes what it returns
    options: tuple[RunOption, ...] = ()  # further options of `pano-mvs run` that belong to it
    size: Callable[[ExecutorRequest], ExecutorSize] = size_of_host


class SerialExecutor(Executor):
    """Computes each job when `wait` is called."""

    name = "serial"
    capacity = 1
    enforces_timeouts = False

    def __init__(self, store: Store, *, threads: int = 0) -> None:
        self.threads = self.cores = threads or available_threads()
        self._store = store
        self._jobs: list[Job] = []
        self._remotes: list[RemoteStage] = []

    def submit(self, job: Job) -> None:
        """Keep a job for `wait`."""
        self._jobs.append(job)

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        """Compute the submitted job; the timeout does not limit its time."""
        if not self._jobs or timeout_s == 0:
            return None
        job = self._jobs.pop(0)
        if (remote := job.unit.entry.spec.remote) is not None and remote not in self._remotes:
            self._remotes.append(remote)
        return job.number, unit_outcome(job.unit, self._store, threads=job.threads, log=job.log)

    def cancel(self) -> None:
        """Forget the job."""
        self._jobs.clear()

    def close(self) -> None:
        """End the processes of stages whose code is elsewhere."""
        for remote in self._remotes:
            remote.close()
        self._remotes.clear()


def _serial(store: Store, request: ExecutorRequest) -> Executor:
    if request.workers > 1:
        raise UsageError("--executor serial runs one unit at a time; for more use --executor processes")
    return SerialExecutor(store, threads=request.threads)


def _processes(store: Store, request: ExecutorRequest) -> Executor:
    workers, threads = shape(request.workers, request.threads)
    return ProcessExecutor(store, workers=workers, threads=threads)


def _size_of_serial(request: ExecutorRequest) -> ExecutorSize:
    return replace(size_of_host(replace(request, workers=1)), threads=request.threads or available_threads())


EXECUTORS = Door[ExecutorKind](
    "executor",
    "pano_mvs.executors",
    {"serial": ExecutorKind(_serial, size=_size_of_serial), "processes": ExecutorKind(_processes)},
    accepts=lambda value: value if isinstance(value, ExecutorKind) else None,
)
VARIABLE = "PANO_MVS_EXECUTOR"
_EXPECTED = ("name", "capacity", "threads", "cores", "submit", "wait", "cancel", "close")  # of an executor


def register_executor(
    name: str, *, options: tuple[RunOption, ...] = ()
) -> Callable[[Callable[[Store, ExecutorRequest], Executor]], Callable[[Store, ExecutorRequest], Executor]]:
    """Return a decorator that registers a function as the executor `name`, for `pano-mvs run --executor NAME`.

    Args:
        options: further options of `pano-mvs run` that belong to it; their values are in `ExecutorRequest.options`.
    """

    def register(make: Callable[[Store, ExecutorRequest], Executor]) -> Callable[[Store, ExecutorRequest], Executor]:
        EXECUTORS.register(name, ExecutorKind(make, options), make)
        return make

    return register


def executor_options() -> dict[str, RunOption]:
    """Return the options that executors add to `pano-mvs run`, by name; plugins that cannot be loaded have none."""
    found: dict[str, RunOption] = {}
    for name in EXECUTORS.names():
        try:
            found |= {option.name: option for option in EXECUTORS.get(name).options}
        except PluginError:
            continue
    return found


def chosen(request: ExecutorRequest) -> tuple[ExecutorKind, ExecutorRequest]:
    """Return the executor that a run asks for, and the request with its name.

    Without a name, it is the only one that has an option that is given, else $PANO_MVS_EXECUTOR (unless a number of
    workers is given), else processes.

    Raises:
        UsageError: if there is no such executor, or it has no such option.
        PluginError: if it cannot be loaded.
    """
    name = request.name or _owner(request.options) or ("" if request.workers else os.environ.get(VARIABLE, ""))
    name = name or "processes"
    kind = EXECUTORS.get(name)
    own = {option.name for option in kind.options}
    for option in request.options:
        if option not in own:
            others = [other for other in EXECUTORS.names() if option in _options_of(other)]
            raise UsageError(f"--{option} requires --executor {' or '.join(others) or '…'}; {name} has no such option")
    return kind, replace(request, name=name)


def _owner(options: Mapping[str, str]) -> str:
    """Return the only executor that has one of some options; "" if none is the only one."""
    owners = [[name for name in EXECUTORS.names() if option in _options_of(name)] for option in options]
    return next((names[0] for names in owners if len(names) == 1), "")


def _options_of(name: str) -> set[str]:
    try:
        return {option.name for option in EXECUTORS.get(name).options}
    except PluginError:
        return set()


def make_executor(store: Store, request: ExecutorRequest = ExecutorRequest()) -> Executor:
    """Return the executor that a run asks for; the caller closes it.

    Raises:
        UsageError: if the request contradicts itself, or the executor is not installed or cannot be reached.
        PluginError: if its plugin cannot be loaded, or fails.
    """
    kind, request = chosen(request)
    try:
        executor = kind.make(store, request)
    except (PanoMvsError, OSError):
        raise
    except Exception as error:
        raise PluginError(
            f"the executor {request.name!r} ({EXECUTORS.origin(request.name)}) cannot start: {error_summary(error)}"
        ) from error
    missing = [name for name in _EXPECTED if not hasattr(executor, name)]
    if missing:
        raise PluginError(
            f"the executor {request.name!r} ({EXECUTORS.origin(request.name)}) makes an object of "
            f"{type(executor).__name__}, which has no {', '.join(missing)}: derive it from Executor"
        )
    return executor


def executor_size(request: ExecutorRequest) -> ExecutorSize:
    """Return how much the executor that a run asks for computes at a time, without starting it.

    Raises:
        UsageError: if the request contradicts itself.
    """
    kind, request = chosen(request)
    return kind.size(request)


def shape(workers: int = 0, threads: int = 0) -> tuple[int, int]:
    """Return the number of workers on this host and the threads of each, as `make_executor` chooses them."""
    cores = available_threads()
    if not workers and not threads:
        workers = max(1, min(cores, free_memory_bytes() // WORKER_BYTES or cores))
    return share_cores(cores, workers=workers, threads=threads)
