"""The events of a run, and its result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from pano_mvs.engine.workflows.workflow import StageEntry

_MIN_UNITS_WITHOUT_SLOWEST = 4

UnitStatus = Literal["cached", "run", "failed", "blocked"]


@dataclass(frozen=True, slots=True)
class Failure:
    """A unit without a result.

    Attributes:
        stage: name of the stage in the workflow.
        item: the unit; empty if the stage has one only.
        cause: what went wrong and what to do.
        trace: the Python traceback, if the code of the stage failed.
        consequence: what is missing in the results because of it.
        blocked: whether the unit did not run because one of its inputs failed.
        log: file with what the unit printed; empty if it printed nothing.
        said: the last lines of the log.
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
    """Return what is missing in the results without a unit."""
    kind = entry.spec.output.kind_name()
    return f"there is no {kind} for {item}" if item else f"there is no {kind}"


@dataclass(slots=True)
class StageSummary:
    """What happened in one stage.

    Attributes:
        name: of the stage in the workflow.
        use: of the stage in the registry.
        units: number of its units.
        cached: number of units that were found in the cache.
        run: number of units that were computed.
        failed: number of units that failed.
        blocked: number of units that did not run because an input failed.
        seconds: time during which at least one of its units was being computed; other stages may have run too.
        unit_seconds: computing time of its units together.
        slowest_s: computing time of its slowest unit.
        stored_bytes: bytes of the results that its computed units stored in the cache.
        metrics: mean of each metric over the units.
        unit_metrics: unit to its own metrics.
        notes: what a user should know.
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
    slowest_s: float = 0.0
    stored_bytes: int = 0
    metrics: dict[str, float] = field(default_factory=dict)
    unit_metrics: dict[str, Mapping[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def typical_unit_s(self) -> float:
        """Mean time of its computed units; of four or more without the slowest, which may include compilation."""
        if self.run >= _MIN_UNITS_WITHOUT_SLOWEST:
            return max(0.0, self.unit_seconds - self.slowest_s) / (self.run - 1)
        return self.unit_seconds / self.run if self.run else 0.0


@dataclass(slots=True)
class RunResult:
    """What a run did.

    Attributes:
        stages: those that were started, in the order of the workflow.
        failures: units without a result.
        rejected: image to the stage that left it out and the reason.
        doubts: image to the stage that finds it doubtful and the reason; see `Record.doubted`.
        stopped: why the run ended early; empty if it did not.
        exit_code: 0 ok, 3 finished with failed or doubtful items, 4 stopped by a threshold or by `on_error: stop`.
        written: files that this run wrote into the output folder.
        removed: files of earlier runs that this run deleted.
        published: every file of the results, with its digest.
        left_over: files of earlier runs, with their digests, that are not part of the results and still exist.
        warnings: such as damaged files of the cache that were computed again.
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
        """Whether nothing failed and no image was left out; doubtful results count as complete."""
        return not (self.stopped or self.failures or self.rejected)

    @property
    def computed(self) -> int:
        """Number of units that were computed rather than found in the cache."""
        return sum(stage.run for stage in self.stages)

    @property
    def cached(self) -> int:
        """Number of units that were found in the cache."""
        return sum(stage.cached for stage in self.stages)


class Observer:
    """Is notified of what a run does, as the progress bars of the command line are; this one ignores everything.

    Stages overlap. If a damaged file is found in the cache, the run makes another pass and its stages start again.
    """

    def stage_started(self, name: str, units: int) -> None:
        """The units of a stage are known."""

    def unit_started(self, name: str, item: str) -> None:
        """A unit is being computed; this is not called for cached and blocked units."""

    def unit_failed(self, failure: Failure) -> None:
        """A unit has failed, after all its retries; `unit_finished` follows."""

    def unit_finished(self, name: str, item: str, *, status: UnitStatus, seconds: float) -> None:
        """A unit is settled; `seconds` is its computing time, 0 if it was not computed."""

    def stage_finished(self, summary: StageSummary) -> None:
        """A stage is complete."""

    def waiting(self) -> None:
        """Called every few seconds while units are being computed and nothing else happens, if the executor allows."""

    def warn(self, text: str) -> None:
        """There is a warning for the user; the run goes on."""
