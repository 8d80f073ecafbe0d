"""Pass units to an executor and collect the outcomes: job numbers, memory, retries, logs."""

from __future__ import annotations

import re
import shutil
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.errors import ContractError
from pano_mvs.core.files import temporary_prefix
from pano_mvs.core.memory import MAX_BYTES, size_text
from pano_mvs.core.paths import is_inside, stat_of
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.executors.capture import tail
from pano_mvs.engine.executors.execute import arguments_of
from pano_mvs.engine.executors.protocol import Executor, Job, JobOutcome
from pano_mvs.engine.executors.unit_requests import has_large_inputs
from pano_mvs.engine.planning.units import PENDING, Unit
from pano_mvs.scene import Record

LOG_FOLDER = "logs"
_INVALID_CHARACTERS = re.compile(r'[<>:"\\|?*\x00-\x1f]')


@dataclass(frozen=True, slots=True)
class FinishedJob:
    """A job that has ended, after all its retries."""

    unit: Unit
    outcome: JobOutcome  # what became of the last attempt
    log: Path | None = None  # file with what the unit printed; None if it printed nothing
    said: tuple[str, ...] = ()  # the last lines of the log


@dataclass(slots=True)
class _RunningJob:
    job: Job
    attempts: int = 1


class Dispatcher:
    """Keeps track of the jobs that an executor is working on."""

    def __init__(
        self, executor: Executor, store: Store, *, out: Path, plugins: Mapping[Path, str], isolate: bool = False
    ) -> None:
        """Prepare.

        Args:
            out: the output folder, for logs.
        """
        self._executor = executor
        self._isolate = isolate
        self._plugins = plugins
        self._store = store
        self._logs = out / LOG_FOLDER
        self._running: dict[int, _RunningJob] = {}
        self._next_number = 0
        self._free_bytes = 0
        self._memory = UnitMemory(store)

    def __len__(self) -> int:
        return len(self._running)

    @property
    def has_capacity(self) -> bool:
        """Whether the executor takes another job."""
        return len(self._running) < self._executor.capacity

    def fits(self, unit: Unit) -> bool:
        """Return whether the memory that a unit declares is free beside that of the running ones.

        Raises:
            Exception: any exception of the stage's function for its memory.
        """
        needed = self._memory.of(unit)
        if not needed:
            return True
        used = sum(running.job.memory_bytes for running in self._running.values())
        if not used:
            self._free_bytes = self._executor.free_memory_bytes()
        return not self._free_bytes or used + needed <= self._free_bytes

    def refusal(self, unit: Unit) -> str:
        """Return the message for a unit that does not fit although no other one is running."""
        needed, free = size_text(self._memory.of(unit)), size_text(self._free_bytes)
        return (
            f"it declares {needed} of memory, and {free} are free. Close other programs, use smaller images or "
            f"settings, or state with `memory:` in stage {unit.entry.name!r} how much it really needs"
        )

    def submit(self, unit: Unit, *, siblings: int) -> None:
        """Pass a unit to the executor.

        Args:
            siblings: number of units of its stage; if they are few, each may use more threads.
        """
        threads = max(self._executor.threads, self._executor.cores // siblings)
        log = self._store.blobs.temporary / f"{temporary_prefix()}log-{uuid.uuid4().hex}.txt"
        fresh = self._isolate and not unit.entry.spec.is_built_in
        memory, timeout_s = self._memory.of(unit), unit.entry.policy.timeout_s
        job = Job(self._next_number, unit, threads, timeout_s, log, self._plugins, fresh, memory)
        self._next_number += 1
        self._running[job.number] = _RunningJob(job)
        self._executor.submit(job)

    def next_finished(self, timeout_s: float | None = None) -> FinishedJob | None:
        """Return a job that has ended; failed jobs are submitted again as long as they have retries left.

        Args:
            timeout_s: how long to wait for one; None waits until a job ends.

        Returns:
            The job, or None if none ended in time or none is running.
        """
        while self._running and (found := self._executor.wait(timeout_s)) is not None:
            number, outcome = found
            running = self._running[number]
            # The system may kill a process through no fault of the unit.
            retries = max(running.job.unit.entry.policy.retries, 2 if outcome.died else 0)
            if outcome.status == "failed" and running.attempts <= retries:
                running.attempts += 1
                self._executor.submit(running.job)
                continue
            del self._running[number]
            _remove_inputs_file(running.job)
            log, said = self._keep_log(running.job)
            return FinishedJob(running.job.unit, outcome, log, said)
        return None

    def cancel(self) -> None:
        """End all jobs at once."""
        self._executor.cancel()
        for running in self._running.values():
            with suppress(OSError):
                running.job.log.unlink(missing_ok=True)
            _remove_inputs_file(running.job)
        self._running.clear()

    def _keep_log(self, job: Job) -> tuple[Path | None, tuple[str, ...]]:
        """Move a unit's log into the output folder, where it replaces that of an earlier run."""
        unit = job.unit
        path = self._logs / f"{log_name(unit.entry.name, unit.item)}.log"
        said = tail(job.log, 20)
        if not is_inside(path.parent, self._logs.parent):
            return None, said  # a link, or the name of an item of a plugin, leads outside
        with suppress(OSError):  # the run does not fail because of a log
            found = stat_of(job.log)
            if found is None or found.st_size == 0:  # a process that died leaves an empty one
                job.log.unlink(missing_ok=True)
                path.unlink(missing_ok=True)
                return None, said
            path.parent.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)  # so that a link there is not followed
            shutil.move(job.log, path)
            return path, said
        with suppress(OSError):
            job.log.unlink(missing_ok=True)  # there is no room for it in the output folder
        return None, said


def _remove_inputs_file(job: Job) -> None:
    if has_large_inputs(job.unit):
        with suppress(OSError):
            job.inputs_file.unlink(missing_ok=True)


def log_name(stage: str, item: str) -> str:
    """Return the path of a unit's log in the log folder, without its suffix, in characters that every system allows."""
    name = _INVALID_CHARACTERS.sub("_", f"{stage}/{item}") if item else stage
    return "/".join("__" if part == ".." else part for part in name.split("/"))


class UnitMemory:
    """The memory that units need."""

    def __init__(self, store: Store) -> None:
        """`store`: where their inputs are."""
        self._store = store
        self._loading_bytes: dict[str, int] = {}  # digest of an input to the memory that reading it takes
        self._latest = ("", 0)  # key and memory of the unit that was asked for last

    def of(self, unit: Unit) -> int:
        """Return the bytes that a unit needs; 0 if neither the workflow, the stage nor the inputs state it."""
        if self._latest[0] != unit.key:
            loading = 0 if unit.entry.policy.memory_bytes else self._loading_of(unit)
            # Every worker has as much as this for reading inputs.
            counted = loading if loading >= 300_000_000 else 0
            self._latest = unit.key, _declared(unit, self._store) + counted
        return self._latest[1]

    def _loading_of(self, unit: Unit) -> int:
        """Return the temporary memory for reading the largest of a unit's inputs."""
        found: list[tuple[ItemRef, type[Record]]] = []
        for port in unit.entry.spec.ports:
            value = unit.inputs.get(port.name)
            if value is None or port.kind.loading_bytes is Record.loading_bytes:
                continue
            refs = [value] if isinstance(value, ItemRef) else value.values()
            found.extend((ref, port.kind) for ref in refs if ref is not PENDING)
        return max((self._loading_of_item(ref, kind) for ref, kind in found), default=0)

    def _loading_of_item(self, ref: ItemRef, kind: type[Record]) -> int:
        if ref.digest not in self._loading_bytes:
            try:
                size_bytes = self._store.load(ref, kind).loading_bytes()
            except DamagedBlobError:
                return 0  # the unit meets the damage too, and is computed again with its inputs
            self._loading_bytes[ref.digest] = _checked_bytes(size_bytes, f"loading_bytes of {kind.kind_name()}")
        return self._loading_bytes[ref.digest]


def _declared(unit: Unit, store: Store) -> int:
    """Return the bytes that the workflow, or else the stage, declares for a unit; 0 if neither does."""
    spec, stated = unit.entry.spec, unit.entry.policy.memory_bytes
    if stated or spec.memory_needed is None:
        return stated or spec.memory_bytes
    try:
        inputs = {"item": unit.source} if unit.source is not None else arguments_of(unit, store)
        needed = spec.memory_needed(unit.entry.params, inputs)
    except DamagedBlobError:
        return 0  # the unit meets the damage too, and is computed again with its inputs
    return _checked_bytes(needed, f"the function for the memory of stage {spec.name} ({spec.origin})")


def _checked_bytes(returned: float, function: str) -> int:
    """Return a number of bytes that a function, which may be a plugin's, returned.

    Raises:
        ContractError: if no unit can need that many.
    """
    size_bytes = int(returned)
    if not 0 <= size_bytes <= MAX_BYTES:
        raise ContractError(f"{function} must return a number of bytes from 0 to {size_text(MAX_BYTES)}")
    return size_bytes
