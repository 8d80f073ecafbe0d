"""The events of a run, and its result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import ClassVar, Literal, get_args

UnitStatus = Literal["cached", "run", "failed", "blocked"]


@dataclass(frozen=True, slots=True)
class UnitFailed:
    """A unit failed; `UnitFinished` follows."""

    kind: ClassVar[str] = "unit_failed"
    stage: str  # name of the stage in the workflow
    item: str  # the image, pair or view; empty if the stage has one unit
    cause: str  # what went wrong and what to do about it
    consequence: str = ""  # what the result lacks because of it
    log: str = ""  # file with what the unit printed; empty if it printed nothing
    said: tuple[str, ...] = ()  # the last lines that it printed
    trace: str = ""  # the Python traceback, if the code of the stage failed


@dataclass(slots=True)
class StageFinished:
    """A stage is done."""

    kind: ClassVar[str] = "stage_finished"
    stage: str  # its name in the workflow
    use: str  # the registered stage, such as `depth.sweep`
    units: int = 0
    run: int = 0  # of these computed
    cached: int = 0  # taken from the cache
    failed: int = 0  # without a result
    blocked: int = 0  # not run, because an input failed
    # time during which at least one of its units was being computed; other stages may have run too
    seconds: float = 0.0
    unit_seconds: float = 0.0  # sum over its computed units
    # mean over its units of each figure that the stage reports
    metrics: Mapping[str, float] = field(default_factory=dict)


@dataclass(slots=True)
class StageSummary(StageFinished):
    """What has happened in one stage so far: the counts of its event, and what else the summary of the run needs."""

    slowest_s: float = 0.0  # computing time of its slowest unit
    stored_bytes: int = 0  # bytes of the results that its computed units stored in the cache
    unit_metrics: dict[str, Mapping[str, float]] = field(default_factory=dict)  # unit to its own metrics
    notes: list[str] = field(default_factory=list)
    # unit to its own notes, and to the images that it rejects or doubts, with the reasons
    unit_notes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    rejected: dict[str, Mapping[str, str]] = field(default_factory=dict)
    doubts: dict[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def typical_unit_s(self) -> float:
        """Mean time of its computed units; of four or more without the slowest, which may include compilation."""
        if self.run >= 4:
            return max(0.0, self.unit_seconds - self.slowest_s) / (self.run - 1)
        return self.unit_seconds / self.run if self.run else 0.0

    def event(self) -> StageFinished:
        """Return the event that the stage is complete."""
        counts = {each.name: getattr(self, each.name) for each in fields(StageFinished)}
        times = {name: round(counts[name], 6) for name in ("seconds", "unit_seconds")}
        return StageFinished(**counts | times)


@dataclass(slots=True)
class RunResult:
    """What a run did."""

    # those that were started, in the order of the workflow
    stages: list[StageSummary] = field(default_factory=list)
    failures: list[UnitFailed] = field(default_factory=list)
    blocked: list[UnitFailed] = field(default_factory=list)  # units that did not run because one of their inputs failed
    # image to the stage that left it out and the reason
    rejected: dict[str, tuple[str, str]] = field(default_factory=dict)
    # image to the stage that finds it doubtful and the reason; see `Record.doubted`
    doubts: dict[str, tuple[str, str]] = field(default_factory=dict)
    stopped: str = ""  # why the run ended early; empty if it did not
    # 0 ok, 3 finished with failed or doubtful items, 4 stopped by a threshold or by `on_error: stop`
    exit_code: int = 0
    written: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)  # files of earlier runs that this run deleted
    published: Mapping[str, str] = field(default_factory=dict)  # every file of the results, with its digest
    # files of earlier runs, with their digests, that are not part of the results and still exist
    left_over: Mapping[str, str] = field(default_factory=dict)
    # such as damaged files of the cache that were computed again
    warnings: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether nothing failed and no image was left out; doubtful results count as complete."""
        return not (self.stopped or self.failures or self.blocked or self.rejected)

    @property
    def units(self) -> dict[str, int]:
        """Number of units of all stages, by outcome."""
        return {status: sum(getattr(stage, status) for stage in self.stages) for status in get_args(UnitStatus)}

    @property
    def computed(self) -> int:
        """Number of units that were computed rather than found in the cache."""
        return self.units["run"]


@dataclass(frozen=True, slots=True)
class StageStarted:
    """A stage begins; it has this number of units of work."""

    kind: ClassVar[str] = "stage_started"
    stage: str
    units: int


@dataclass(frozen=True, slots=True)
class UnitStarted:
    """A unit begins to be computed; `item` is empty if the stage has one unit."""

    kind: ClassVar[str] = "unit_started"
    stage: str
    item: str


@dataclass(frozen=True, slots=True)
class UnitFinished:
    """A unit is done, after this time; outcomes are "run" (computed), "cached", "failed" and "blocked"."""

    kind: ClassVar[str] = "unit_finished"
    stage: str
    item: str
    outcome: UnitStatus
    seconds: float


@dataclass(frozen=True, slots=True)
class Warned:
    """Something unexpected that does not stop the run."""

    kind: ClassVar[str] = "warning"
    text: str


RunEvent = StageStarted | UnitStarted | UnitFailed | UnitFinished | StageFinished | Warned
Observer = Callable[[RunEvent | None], None]
"""Is called with what a run does, and with None every few seconds in which nothing happens but that units are computed.

Stages overlap. If a damaged file is found in the cache, the run makes another pass and its stages start again.
"""


def ignore(_event: object) -> None:
    """Do nothing with an event."""
