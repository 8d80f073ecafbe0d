"""Pass on what the engine reports of a run as events."""

from __future__ import annotations

import time
from collections.abc import Callable

from pano_mvs.core.kernel_cache import count_compiled
from pano_mvs.engine.running.events import Failure, StageSummary, UnitStatus
from pano_mvs.session.progress import (
    Event,
    KernelsCompiled,
    Progress,
    StageFinished,
    StageStarted,
    UnitFailed,
    UnitFinished,
    UnitStarted,
    Warned,
)
from pano_mvs.session.time_estimator import TimeEstimator

_ESTIMATE_EVERY_S = 1.0


class EventObserver:
    """An observer of the engine's run that passes everything on as events, and adds the time left."""

    def __init__(self, progress: Progress, clock: Callable[[], float] = time.monotonic) -> None:
        self._progress = progress
        self._clock = clock
        self._estimator = TimeEstimator(clock)
        self._next_estimate_s = clock() + _ESTIMATE_EVERY_S
        self._kernels_before = self._kernels = count_compiled()

    def report(self, event: Event) -> None:
        """Pass on an event, and the time left if its last event is a second ago."""
        self._estimator(event)
        self._progress(event)
        self.waiting()

    def stage_started(self, name: str, units: int) -> None:
        """Pass the event on."""
        self.report(StageStarted(name, units))

    def unit_started(self, name: str, item: str) -> None:
        """Pass the event on."""
        self.report(UnitStarted(name, item))

    def unit_failed(self, failure: Failure) -> None:
        """Pass the event on."""
        names = ("stage", "item", "cause", "consequence", "log", "said")
        self.report(UnitFailed(**{name: getattr(failure, name) for name in names}))

    def unit_finished(self, name: str, item: str, *, status: UnitStatus, seconds: float) -> None:
        """Pass the event on."""
        self.report(UnitFinished(name, item, status, round(seconds, 6)))

    def stage_finished(self, summary: StageSummary) -> None:
        """Pass the event on."""
        counts = {name: getattr(summary, name) for name in ("use", "units", "run", "cached", "failed", "blocked")}
        times = {name: round(getattr(summary, name), 6) for name in ("seconds", "unit_seconds")}
        self.report(StageFinished(stage=summary.name, **counts, **times, metrics=dict(summary.metrics)))

    def waiting(self) -> None:
        """Report how many kernels have been compiled, and the time left."""
        now = self._clock()
        if now < self._next_estimate_s:
            return
        since_s = now - self._next_estimate_s + _ESTIMATE_EVERY_S
        self._next_estimate_s = now + _ESTIMATE_EVERY_S
        if (kernels := count_compiled()) > self._kernels:
            self._kernels = kernels
            compiled = KernelsCompiled(kernels - self._kernels_before, round(since_s, 6))
            self._estimator(compiled)
            self._progress(compiled)
        self._progress(self._estimator.estimate())

    def warn(self, text: str) -> None:
        """Pass the event on."""
        self.report(Warned(text))
