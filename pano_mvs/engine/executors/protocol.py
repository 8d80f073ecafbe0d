"""What the scheduler asks of an executor, and what it is told of a unit that was tried."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from pano_mvs.engine.cache.store import UnitRecord
from pano_mvs.engine.planning.units import Unit

JobStatus = Literal["done", "failed", "damaged", "changed", "stopped"]


@dataclass(frozen=True, slots=True)
class Job:
    """A unit to be computed.

    Attributes:
        number: names the job in this run.
        unit: what to compute.
        threads: how many threads it may use.
        timeout_s: the time after which it is given up; 0 for none.
        log: file for whatever the unit prints; it exists afterwards if there was anything.
        plugins: the plugin files of the workflow, with the digests of their code.
    """

    number: int
    unit: Unit
    threads: int
    timeout_s: float
    log: Path
    plugins: Mapping[Path, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """What became of a job.

    Attributes:
        status: `done`; `failed`: the unit has no result; `damaged`: an input turned out damaged and was removed;
            `changed`: a user's file that it reads is not as it was listed; `stopped`: nothing can go on (the disk is
            full, the stage closed a gate).
        record: the stored result of a job that is done.
        cause: what went wrong otherwise.
        trace: the Python traceback, if the stage's own code broke.
        error: name of the error's class, where the scheduler acts on it.
        exit_code: of an error that is the user's to mend, else 0.
        died: whether the process died of it, or took too long and was ended.
        seconds: how long it took.
        changed: the user's files that are not as they were listed, with the reason.
    """

    status: JobStatus
    record: UnitRecord | None = None
    cause: str = ""
    trace: str = ""
    error: str = ""
    exit_code: int = 0
    died: bool = False
    seconds: float = 0.0
    changed: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the outcome as a JSON value."""
        return {
            "status": self.status,
            "record": None if self.record is None else self.record.to_json(),
            "cause": self.cause,
            "trace": self.trace,
            "error": self.error,
            "exit_code": self.exit_code,
            "died": self.died,
            "seconds": self.seconds,
            "changed": dict(self.changed),
        }

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> JobOutcome:
        """Return the outcome that `to_json` gave."""
        record = None if value["record"] is None else UnitRecord.from_json(value["record"])
        return JobOutcome(**{**value, "record": record})


class Executor(Protocol):
    """Computes units, several at a time or one.

    Attributes:
        name: as it is chosen on the command line.
        capacity: how many jobs it takes at a time.
        threads: how many threads a unit may use while as many others run as there can.
        cores: how many threads a unit may use that runs alone.
        enforces_timeouts: whether it can end a unit that takes too long.
    """

    name: str
    capacity: int
    threads: int
    cores: int
    enforces_timeouts: bool

    def submit(self, job: Job) -> None:
        """Take a job; the caller never has more than `capacity` of them out."""

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        """Return the number and the outcome of a job that has ended; None if none has within the time.

        Raises:
            KeyboardInterrupt: if the user interrupts.
        """

    def free_memory_bytes(self) -> int:
        """Return what all units that run at a time may use together; 0 if it is not known."""

    def cancel(self) -> None:
        """End all jobs at once and forget them."""

    def close(self) -> None:
        """Let go of all processes; no job is out any more."""
