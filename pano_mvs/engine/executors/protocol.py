"""The interface of executors: jobs in, outcomes out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Protocol

from pano_mvs.core.memory import free_memory_bytes
from pano_mvs.engine.cache.store import UnitRecord
from pano_mvs.engine.planning.units import Unit

JobStatus = Literal["done", "failed", "damaged", "changed", "stopped"]


@dataclass(frozen=True, slots=True)
class Job:
    """A unit to be computed."""

    number: int
    unit: Unit
    threads: int
    timeout_s: float  # time after which it is ended; 0 for no limit
    log: Path  # file for everything that the unit prints; it does not exist afterwards if nothing was printed
    # the plugin files of the workflow, with the digests of their code
    plugins: Mapping[Path, str] = field(default_factory=dict)
    fresh: bool = False  # whether it needs a process of its own
    memory_bytes: int = 0  # memory that it needs; 0 if unknown

    @property
    def inputs_file(self) -> Path:
        """File for inputs that are too many for a message to a worker; the dispatcher removes it."""
        return self.log.with_suffix(".inputs")


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """What became of a job."""

    # `done`; `failed`: the unit has no result; `damaged`: an input turned out damaged and was removed; `changed`: an
    # input file has changed since it was listed; `stopped`: the run cannot go on (the disk is full, or the stage raised
    # RunStoppedError)
    status: JobStatus
    record: UnitRecord | None = None  # the stored result, if the status is `done`
    cause: str = ""
    trace: str = ""  # the Python traceback, if the code of the stage failed
    error: str = ""  # name of the class of the error, if the run has to raise it again
    exit_code: int = 0  # exit code of an error that the user can fix, otherwise 0
    died: bool = False  # whether the worker process died, or must not compute anything else
    seconds: float = 0.0
    # input files that have changed since they were listed, with the reasons
    changed: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the outcome as a JSON value, without the identity in its record, which is that of the unit."""
        record = None if self.record is None else replace(self.record, identity={}).to_json()
        return {one.name: getattr(self, one.name) for one in fields(self)} | {"record": record}

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> JobOutcome:
        """Return the outcome from the result of `to_json`."""
        record = None if value["record"] is None else UnitRecord.from_json(value["record"])
        return JobOutcome(**{**value, "record": record})


class Executor(Protocol):
    """Computes units, several at a time or one."""

    name: str
    capacity: int  # number of jobs that it takes at a time
    threads: int  # number of threads for a unit while `capacity` units run
    cores: int  # number of threads for a unit that runs alone
    enforces_timeouts: bool  # whether it can end a unit that takes too long

    def submit(self, job: Job) -> None:
        """Start a job; the caller never submits more than `capacity` at a time."""

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        """Wait for a job to end; return its number and outcome, or None if no job ended within the time.

        Raises:
            KeyboardInterrupt: if the user interrupts.
        """

    def free_memory_bytes(self) -> int:
        """Return the memory for all running units together, by default that of this host; 0 if unknown."""
        return free_memory_bytes()

    def places(self) -> int:
        """Return the number of units that can be computed at a time at this moment, as workers come and go."""
        return self.capacity

    def notice(self) -> str:
        """Return what the user should know now, such as that no worker has started; usually empty."""
        return ""

    def cancel(self) -> None:
        """End all jobs at once and forget them."""

    def close(self) -> None:
        """End all processes; no job is running."""
