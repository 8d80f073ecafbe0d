"""What a run tells while it goes on, and what it returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from pano_mvs.engine.workflows.workflow import StageEntry

UnitStatus = Literal["cached", "run", "failed", "blocked"]


@dataclass(frozen=True, slots=True)
class Failure:
    """A unit without a result.

    Attributes:
        stage: name of the stage in the workflow.
        item: the unit; empty if the stage has one only.
        cause: what went wrong and what to do.
        trace: the Python traceback, if the stage's own code broke.
        consequence: what the result lacks because of it.
        blocked: whether the unit did not even run, for want of an input that failed.
        log: file with what the unit printed, if it printed anything.
        said: the last lines of it.
    """

    stage: str
    item: str
    cause: str
    trace: str = ""
    consequence: str = ""
    blocked: bool = False
    log: str = ""
    said: tuple[str, ...] = ()


def consequence_of(entry: StageEntry, item: str) -> str:
    """Return what the result lacks without a unit."""
    kind = entry.spec.output.kind_name()
    return f"there is no {kind} for {item}" if item else f"there is no {kind}"


@dataclass(slots=True)
class StageSummary:
    """What happened in one stage; metrics are means over its units, `unit_metrics` each unit's own.

    `seconds` passed from its first unit to its last, in which units of other stages may have run too; its own units
    took `unit_seconds` together.
    """

    name: str
    use: str
    units: int = 0
    cached: int = 0
    run: int = 0
    failed: int = 0
    blocked: int = 0
    seconds: float = 0.0
    unit_seconds: float = 0.0
    metrics: dict[str, float] = field(default_factory=dict)
    unit_metrics: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@dataclass(slots=True)
class RunResult:
    """What a run did.

    Attributes:
        stages: those that were begun, in the order of the workflow.
        failures: units without a result.
        rejected: image to the stage that left it out and why.
        doubts: image to the stage that finds it doubtful and why; see `Record.doubted`.
        stopped: why the run ended early; empty if it did not.
        exit_code: 0 ok, 3 finished with failed or doubtful items, 4 stopped by a gate.
        left_over: files, with their digests, of earlier runs that this one did not write and that are still there.
        written: files written into the output folder by this run.
        warnings: damaged parts of the store that were computed again, and the like.
    """

    stages: list[StageSummary] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    rejected: dict[str, tuple[str, str]] = field(default_factory=dict)
    doubts: dict[str, tuple[str, str]] = field(default_factory=dict)
    stopped: str = ""
    exit_code: int = 0
    written: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    published: Mapping[str, str] = field(default_factory=dict)
    left_over: Mapping[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether the run made all that it was to make; doubtful results count as made."""
        return not (self.stopped or self.failures or self.rejected)

    @property
    def computed(self) -> int:
        """Number of units that were computed rather than found in the cache."""
        return sum(stage.run for stage in self.stages)

    @property
    def cached(self) -> int:
        """Number of units that were found in the cache."""
        return sum(stage.cached for stage in self.stages)


class Observer(Protocol):
    """Hears what a run does; the command line's progress bars are one.

    Stages overlap. Where a damaged part of the store is found, the run starts over and its stages start again.
    """

    def stage_started(self, name: str, units: int) -> None:
        """A stage's units are known."""

    def unit_started(self, name: str, item: str) -> None:
        """A unit is being computed; one that is cached or blocked is not."""

    def unit_failed(self, failure: Failure) -> None:
        """A unit has failed, after all its tries; `unit_finished` follows."""

    def unit_finished(self, name: str, item: str, outcome: UnitStatus, seconds: float) -> None:
        """A unit is done; `seconds` is how long it took to compute."""

    def stage_finished(self, summary: StageSummary) -> None:
        """A stage is done."""

    def warn(self, text: str) -> None:
        """Something the user should know, though the run goes on."""


class SilentObserver:
    """An observer that says nothing."""

    def stage_started(self, name: str, units: int) -> None:
        """Say nothing."""

    def unit_started(self, name: str, item: str) -> None:
        """Say nothing."""

    def unit_failed(self, failure: Failure) -> None:
        """Say nothing."""

    def unit_finished(self, name: str, item: str, outcome: UnitStatus, seconds: float) -> None:
        """Say nothing."""

    def stage_finished(self, summary: StageSummary) -> None:
        """Say nothing."""

    def warn(self, text: str) -> None:
        """Say nothing."""
