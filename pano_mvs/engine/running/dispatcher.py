"""Hand units to an executor and take their outcomes back: numbers, memory, further tries, logs."""

from __future__ import annotations

import re
import shutil
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.files import temporary_prefix
from pano_mvs.core.paths import resolved, stat_of
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.executors.capture import tail
from pano_mvs.engine.executors.protocol import Executor, Job, Outcome
from pano_mvs.engine.planning.units import PENDING, Unit
from pano_mvs.engine.running.execute import arguments_of
from pano_mvs.engine.running.memory import size_text
from pano_mvs.scene import Record

LOG_FOLDER = "logs"
_SHOWN_LINES = 20
_TRIES_AFTER_DEATH = 2
_COUNTED_BYTES = 300_000_000  # what reading inputs takes counts from here on; every worker has room for less
_NOT_IN_NAMES = re.compile(r'[<>:"\\|?*\x00-\x1f]')


@dataclass(frozen=True, slots=True)
class Ended:
    """A job that has ended, after all its tries.

    Attributes:
        unit: what was to be computed.
        outcome: of the last try.
        log: where what it printed is kept, if it printed anything.
        said: the last lines of it.
    """

    unit: Unit
    outcome: Outcome
    log: Path | None
    said: tuple[str, ...]


@dataclass(slots=True)
class _Out:
    job: Job
    memory_bytes: int
    tries: int = 1


class Desk:
    """The jobs that are out."""

    def __init__(self, executor: Executor, store: Store, out: Path, plugins: Mapping[Path, str]) -> None:
        self._executor = executor
        self._plugins = plugins
        self._store = store
        self._logs = out / LOG_FOLDER
        self._out: dict[int, _Out] = {}
        self._next = 0
        self._free_bytes = 0
        self._loading_bytes: dict[str, int] = {}  # of inputs, by their digest
        self._latest = ("", 0)  # the key of the unit that was asked for last, and its memory

    def __len__(self) -> int:
        """Return how many jobs are out."""
        return len(self._out)

    @property
    def has_room(self) -> bool:
        """Whether the executor takes a further job."""
        return len(self._out) < self._executor.capacity

    def fits(self, unit: Unit) -> bool:
        """Return whether a unit's declared memory is free beside that of those that are out."""
        wanted = self._memory_of(unit)
        if not wanted:
            return True
        used = sum(out.memory_bytes for out in self._out.values())
        if not used:
            self._free_bytes = self._executor.free_memory_bytes()
        return not self._free_bytes or used + wanted <= self._free_bytes

    def refusal(self, unit: Unit) -> str:
        """Return why a unit that does not fit, though nothing else is out, cannot run at all."""
        wanted, free = size_text(self._memory_of(unit)), size_text(self._free_bytes)
        return (
            f"it declares {wanted} of memory, and {free} are free. Close other programs, use smaller pictures or "
            f"settings, or say with `memory:` in stage {unit.entry.name!r} what it really needs"
        )

    def hand_out(self, unit: Unit, *, siblings: int) -> None:
        """Give a unit to the executor; if its stage has few units, each of them may use the more threads."""
        threads = max(self._executor.threads, self._executor.cores // siblings)
        log = self._store.blobs.temporary / f"{temporary_prefix()}log-{uuid.uuid4().hex}.txt"
        job = Job(self._next, unit, threads, unit.entry.policy.timeout_s, log, self._plugins)
        self._next += 1
        self._out[job.number] = _Out(job, self._memory_of(unit))
        self._executor.submit(job)

    def take(self, timeout_s: float | None = None) -> Ended | None:
        """Return a job that has ended; one that may be tried again is, and does not count as ended."""
        while self._out and (found := self._executor.wait(timeout_s)) is not None:
            number, outcome = found
            out = self._out[number]
            # A process may be killed for no fault of the unit: that alone costs none.
            further = max(out.job.unit.entry.policy.retries, _TRIES_AFTER_DEATH if outcome.died else 0)
            if outcome.status == "failed" and out.tries <= further:
                out.tries += 1
                self._executor.submit(out.job)
                continue
            del self._out[number]
            log, said = self._keep_log(out.job)
            return Ended(out.job.unit, outcome, log, said)
        return None

    def cancel(self) -> None:
        """End all jobs at once."""
        self._executor.cancel()
        for out in self._out.values():
            with suppress(OSError):
                out.job.log.unlink(missing_ok=True)
        self._out.clear()

    def _memory_of(self, unit: Unit) -> int:
        """Return the bytes that a unit takes, as far as anybody says so; 0 if nobody does."""
        if self._latest[0] != unit.key:
            loading = 0 if unit.entry.policy.memory_bytes else self._loading_of(unit)
            counted = loading if loading >= _COUNTED_BYTES else 0
            self._latest = unit.key, memory_of(unit, self._store) + counted
        return self._latest[1]

    def _loading_of(self, unit: Unit) -> int:
        """Return the most that reading one of a unit's inputs takes for a moment."""
        most = 0
        for port in unit.entry.spec.ports:
            value = unit.inputs.get(port.name)
            if value is None or port.kind.loading_bytes is Record.loading_bytes:
                continue
            for ref in [value] if isinstance(value, ItemRef) else value.values():
                if ref is PENDING:
                    continue
                if ref.digest not in self._loading_bytes:
                    try:
                        self._loading_bytes[ref.digest] = self._store.load(ref, port.kind).loading_bytes()
                    except DamagedBlobError:
                        continue  # the unit meets it too, and is computed again with what it reads
                most = max(most, self._loading_bytes[ref.digest])
        return most

    def _keep_log(self, job: Job) -> tuple[Path | None, tuple[str, ...]]:
        """Move what a unit printed into the output folder; of an earlier run there is nothing left."""
        unit = job.unit
        path = self._logs / f"{log_name(unit.entry.name, unit.item)}.log"
        said = tail(job.log, _SHOWN_LINES)
        if not resolved(path.parent).is_relative_to(resolved(self._logs.parent)):
            return None, said  # a link, or a plugin's name of an item, leads outside
        with suppress(OSError):  # a log is not worth failing for
            found = stat_of(job.log)
            if found is None or found.st_size == 0:  # a process that died of it leaves an empty one
                job.log.unlink(missing_ok=True)
                path.unlink(missing_ok=True)
                return None, said
            path.parent.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)  # a link there is not followed
            shutil.move(job.log, path)
            return path, said
        with suppress(OSError):
            job.log.unlink(missing_ok=True)  # there is no room for it in the output folder
        return None, said


def memory_of(unit: Unit, store: Store) -> int:
    """Return the bytes that a unit declares, in the workflow or else in its stage; 0 if it does not."""
    spec, stated = unit.entry.spec, unit.entry.policy.memory_bytes
    if stated or spec.memory_needed is None:
        return stated or spec.memory_bytes
    try:
        inputs = {"item": unit.source} if unit.source is not None else arguments_of(unit, store)
        return spec.memory_needed(unit.entry.params, inputs)
    except DamagedBlobError:
        return 0  # the unit meets it too, and is computed again with what it reads


def log_name(stage: str, item: str) -> str:
    """Return a unit's log relative to the folder of logs, without its suffix; every system takes such names."""
    name = _NOT_IN_NAMES.sub("_", f"{stage}/{item}") if item else stage
    return "/".join("__" if part == ".." else part for part in name.split("/"))
