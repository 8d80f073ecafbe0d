"""Events of a run, as typed records for a callback.

A run reports `RunStarted`, then events of its stages and units, then `RunFinished`, which is always the last. Stages
overlap. If a damaged file is found in the cache, the run starts over: `StageStarted` is repeated for every stage, and
earlier counts no longer apply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from pano_mvs.engine.running.events import Failure, StageSummary, UnitStatus
from pano_mvs.results.records import Verdict


@dataclass(frozen=True, slots=True)
class RunStarted:
    """The run begins.

    Attributes:
        workflow: its name.
        stages: names of its stages, in order.
        executor: `processes`, `serial` or `dask`.
        workers: number of units at a time.
        threads: of each worker.
        out: the output folder.
    """

    kind: ClassVar[str] = "run_started"
    workflow: str
    stages: tuple[str, ...]
    executor: str
    workers: int
    threads: int
    out: Path


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
class UnitFailed:
    """A unit failed; `UnitFinished` follows.

    Attributes:
        stage: name of the stage in the workflow.
        item: the image, pair or view; empty if the stage has one unit.
        cause: what went wrong and what to do about it.
        consequence: what the result lacks because of it.
        log: file with what the unit printed; empty if it printed nothing.
        said: the last lines that it printed.
    """

    kind: ClassVar[str] = "unit_failed"
    stage: str
    item: str
    cause: str
    consequence: str = ""
    log: str = ""
    said: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class UnitFinished:
    """A unit is done, after this time; outcomes are "run" (computed), "cached", "failed" and "blocked"."""

    kind: ClassVar[str] = "unit_finished"
    stage: str
    item: str
    outcome: UnitStatus
    seconds: float


@dataclass(frozen=True, slots=True)
class StageFinished:
    """A stage is done.

    Attributes:
        stage: its name in the workflow.
        use: the registered stage, such as `depth.sweep`.
        units: number of units.
        run: of these computed.
        cached: taken from the cache.
        failed: without a result.
        blocked: not run, because an input failed.
        seconds: from the start of its first unit to the end of its last.
        unit_seconds: sum over its computed units.
        metrics: mean over its units of each figure that the stage reports.
    """

    kind: ClassVar[str] = "stage_finished"
    stage: str
    use: str
    units: int
    run: int
    cached: int
    failed: int
    blocked: int
    seconds: float
    unit_seconds: float
    metrics: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Warned:
    """Something unexpected that does not stop the run."""

    kind: ClassVar[str] = "warning"
    text: str


@dataclass(frozen=True, slots=True)
class RunFinished:
    """The run has ended, also if it was interrupted or raised an error.

    Attributes:
        exit_code: as of `RunSummary`.
        stopped: why it ended early; empty if it did not.
        run: number of computed units.
        cached: units taken from the cache.
        failed: units without a result.
        blocked: units that did not run because an input failed.
        seconds: that the run took.
        out: the output folder.
        verdict: on the result; None if the run was aborted.
        doubts: doubtful image to the reason.
    """

    kind: ClassVar[str] = "run_finished"
    exit_code: int
    stopped: str
    run: int = 0
    cached: int = 0
    failed: int = 0
    blocked: int = 0
    seconds: float = 0.0
    out: Path = Path()
    verdict: Verdict | None = None
    doubts: Mapping[str, str] = field(default_factory=dict)


Event = RunStarted | StageStarted | UnitStarted | UnitFailed | UnitFinished | StageFinished | Warned | RunFinished
Progress = Callable[[Event], None]


def ignore(_event: Event) -> None:
    """Do nothing with an event."""


class EventObserver:
    """An observer of the engine's run that passes everything on as events."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def stage_started(self, name: str, units: int) -> None:
        """Pass the event on."""
        self._progress(StageStarted(name, units))

    def unit_started(self, name: str, item: str) -> None:
        """Pass the event on."""
        self._progress(UnitStarted(name, item))

    def unit_failed(self, failure: Failure) -> None:
        """Pass the event on."""
        names = ("stage", "item", "cause", "consequence", "log", "said")
        self._progress(UnitFailed(**{name: getattr(failure, name) for name in names}))

    def unit_finished(self, name: str, item: str, *, status: UnitStatus, seconds: float) -> None:
        """Pass the event on."""
        self._progress(UnitFinished(name, item, status, round(seconds, 6)))

    def stage_finished(self, summary: StageSummary) -> None:
        """Pass the event on."""
        counts = {name: getattr(summary, name) for name in ("use", "units", "run", "cached", "failed", "blocked")}
        times = {name: round(getattr(summary, name), 6) for name in ("seconds", "unit_seconds")}
        self._progress(StageFinished(stage=summary.name, **counts, **times, metrics=dict(summary.metrics)))

    def warn(self, text: str) -> None:
        """Pass the event on."""
        self._progress(Warned(text))
