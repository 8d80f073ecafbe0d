"""Estimate the time that a run has left, from its events; nothing here draws or sleeps.

    estimator = TimeEstimator()
    estimator(event)            # for each event of the run
    estimator.estimate()        # at any time

The estimate starts from the forecast of the run (`Forecast`), which comes from earlier runs, and moves to what the
units of each stage take in this one. A stage that nobody has experience with counts as soon as one of its units is
being computed; until then the estimate is a lower bound. So it is while kernels are to be compiled, which takes a time
that no run knows beforehand: until each stage has computed a unit, if none was compiled before the run, or one is
during it.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from pano_mvs.core.kernel_cache import count_compiled
from pano_mvs.engine.executors.protocol import Executor
from pano_mvs.engine.planning.forecast import StageForecast, makespan
from pano_mvs.engine.running.events import StageFinished, StageStarted, UnitFinished, UnitStarted, Warned
from pano_mvs.session.progress import (
    Event,
    Forecast,
    KernelsCompiled,
    Progress,
    RunFinished,
    RunStarted,
    TimeLeft,
    WorkersChanged,
)

_OVERDUE = 1.2  # a unit that takes longer than expected is expected to take this multiple of its time so far …
_UNKNOWN = 2.0  # … and this one if nothing is known of its stage

_SPEED_PRIOR_S = 10.0
_COMPUTED = ("run", "failed")


@dataclass(slots=True)
class StageProgress:
    """What is known of one stage."""

    forecast: StageForecast
    units: int | None = None  # number of its units; None until the stage has started
    done: int = 0  # number of settled units
    computed: int = 0  # number of these that were computed
    seconds: float = 0.0  # computing time of these
    running: dict[str, float] = field(default_factory=dict)  # unit to the time at which it began
    # the largest number of units of all stages that ran at a time while one of this stage did
    most_at_once: int = 0
    finished: bool = False  # whether all units are settled
    _own_s: float = 0.0
    _began: float = 0.0

    def start(self, item: str, now: float) -> None:
        """Note that a unit is being computed."""
        if not self.running:
            self._began = now
        self.running[item] = now

    def wait(self, seconds: float, now: float) -> None:
        """Note that running units have waited, as they do for kernels to be compiled: other units will not."""
        self.running = {item: min(now, began + seconds) for item, began in self.running.items()}

    def end(self, item: str, now: float) -> None:
        """Note that a unit is settled."""
        if self.running.pop(item, None) is not None and not self.running:
            self._own_s += now - self._began
        self.done += 1

    def own_s(self, now: float) -> float:
        """Return the time during which at least one of its units was being computed."""
        return self._own_s + (now - self._began if self.running else 0.0)

    def unit_s(self, now: float, speed: float) -> float | None:
        """Return the expected time of one of its units; None if nothing is known.

        The forecast counts like one finished unit of this run.

        Args:
            speed: factor for the forecast, see `TimeEstimator`.
        """
        longest_s = max((now - began for began in self.running.values()), default=0.0)
        expected_s = None if self.forecast.unit_s is None else self.forecast.unit_s * speed
        if not self.computed:
            if expected_s is None:
                return _UNKNOWN * longest_s if self.running else None
            # A worker process starts within this time, which is not evidence that the units of its stage are slow.
            return max(expected_s, _OVERDUE * (longest_s - 10.0))
        known = 0 if expected_s is None else 1
        return ((expected_s or 0.0) + self.seconds) / (known + self.computed)

    def units_left(self) -> int | None:
        """Return the expected number of units that are computed or wait for it; None if unknown."""
        if self.finished:
            return 0
        if self.units is None:
            return self.forecast.units
        unsettled = self.units - self.done
        expected = unsettled if self.forecast.units is None else self.units - self.forecast.cached - self.computed
        is_refuted = expected < len(self.running)  # units that should have been in the cache are computed
        return unsettled if is_refuted else min(unsettled, expected)

    def work_s(self, now: float, speed: float) -> tuple[float, float] | None:
        """Return the computing time that is left and that which is done; None if unknown."""
        elapsed = [now - began for began in self.running.values()]
        units = self.units_left()
        if units == 0:
            return 0.0, self.seconds
        unit_s = self.unit_s(now, speed)
        if unit_s is None or units is None:
            return None
        running_s = sum(max(unit_s - so_far, (_OVERDUE - 1) * so_far) for so_far in elapsed)
        done_s = self.seconds + sum(min(unit_s, so_far) for so_far in elapsed)  # a worker may still be starting
        return running_s + max(0, units - len(elapsed)) * unit_s, done_s


class TimeEstimator:
    """Keeps track of a run by its events; several threads may use it at a time."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.stages: dict[str, StageProgress] = {}
        self._clock = clock
        self._lock = threading.Lock()
        self._workers = 1
        self._most_done = 0.0
        self._report_s = 0.0
        self._latest_end = 0.0
        self._is_over = False
        self._compiles = False

    @property
    def is_reporting(self) -> bool:
        """Whether all stages are finished, and the report is being written."""
        return bool(self.stages) and all(stage.finished for stage in self.stages.values())

    def __call__(self, event: Event) -> None:
        """Take an event into account."""
        with self._lock:
            self._take(event)

    def estimate(self) -> TimeLeft:
        """Return the estimate at this moment; it is the same for the same events and time."""
        with self._lock:
            return self._estimate()

    def _take(self, event: Event) -> None:
        match event:
            case RunStarted():
                self._workers = max(1, event.workers)
                self.stages = {name: StageProgress(StageForecast(name)) for name in event.stages}
            case Forecast():
                self._report_s, self._compiles = event.report_s, event.compiles
                for forecast in event.stages:
                    self._of(forecast.stage).forecast = forecast
                # A run that is limited, such as by `--until`, has a forecast of its own stages alone.
                self.stages = {forecast.stage: self.stages[forecast.stage] for forecast in event.stages}
            case WorkersChanged():
                self._workers = max(1, event.workers)
            case KernelsCompiled():
                self._compiles = True
                for stage in self.stages.values():
                    stage.wait(event.seconds, self._clock())
            case StageStarted():
                # A run that starts over repeats its stages, and finishes again what it has computed.
                self.stages[event.stage] = StageProgress(self._of(event.stage).forecast, event.units)
            case UnitStarted():
                self._of(event.stage).start(event.item, self._clock())
                # Memory may permit fewer units at a time than there are workers.
                running = sum(len(stage.running) for stage in self.stages.values())
                for stage in self.stages.values():
                    stage.most_at_once = max(stage.most_at_once, running if stage.running else 0)
            case UnitFinished():
                stage = self._of(event.stage)
                stage.end(event.item, self._clock())
                if event.outcome in _COMPUTED:
                    stage.computed += 1
                    stage.seconds += event.seconds
            case StageFinished():
                self._of(event.stage).finished = True
                self._latest_end = self._clock()
            case RunFinished():
                self._is_over = True
            case _:
                pass

    def _estimate(self) -> TimeLeft:
        if self._is_over:
            return TimeLeft(0.0, at_least=False, done=1.0)
        timed = [stage for stage in self.stages.values() if stage.forecast.unit_s is not None and stage.computed]
        taken_s = sum(stage.seconds for stage in timed)
        expected_s = sum(stage.computed * (stage.forecast.unit_s or 0.0) for stage in timed)
        least, most = 0.2, 5.0  # earlier runs may have been slower
        now, speed = self._clock(), min(most, max(least, (taken_s + _SPEED_PRIOR_S) / (expected_s + _SPEED_PRIOR_S)))
        work = {name: stage.work_s(now, speed) for name, stage in self.stages.items()}
        known = {name: found for name, found in work.items() if found is not None}
        unknown = tuple(name for name, found in work.items() if found is None)
        left_s = makespan(
            {name: known[name][0] if name in known else 0.0 for name in self.stages},
            {name: self._at_a_time(name) for name in self.stages},
            {name: stage.forecast.after for name, stage in self.stages.items()},
            workers=self._workers,
        )
        so_far_s = now - self._latest_end if self.is_reporting else 0.0
        report = max(self._report_s - so_far_s, (_OVERDUE - 1) * so_far_s), so_far_s
        self._most_done = max(self._most_done, _share([*known.values(), report], len(unknown)))
        compiles = self._compiles and any(
            not stage.computed and stage.units_left() != 0 for stage in self.stages.values()
        )
        return TimeLeft(left_s + report[0], bool(unknown) or compiles, self._most_done, unknown, compiles)

    def _of(self, stage: str) -> StageProgress:
        return self.stages.setdefault(stage, StageProgress(StageForecast(stage)))

    def _at_a_time(self, name: str) -> int:
        stage = self.stages[name]
        units = max(1, stage.units_left() or 1)
        return min(units, stage.most_at_once) if stage.computed and stage.most_at_once else units


class Countdown:
    """Makes a time left readable: it counts down with the clock, and glides to a new estimate within seconds."""

    def __init__(self) -> None:
        self._shown_s = math.nan
        self._at = 0.0

    def show(self, seconds_left: float, now: float) -> float:
        """Return the time to show for an estimate at a time.

        Args:
            now: the time in seconds, which must not decrease.
        """
        if math.isnan(self._shown_s):
            self._shown_s = seconds_left
        else:
            step_s = max(0.0, now - self._at)
            counted_s = self._shown_s - step_s
            self._shown_s = counted_s + (seconds_left - counted_s) * -math.expm1(-step_s / 4.0)
        self._at = now
        return max(0.0, self._shown_s)


def _share(work: Sequence[tuple[float, float]], unknown: int) -> float:
    """Return the share of the work that is done.

    Args:
        work: seconds that are left and seconds that are done, of each stage of which anything is known.
        unknown: number of the other stages, each of which counts like the mean of the known ones.
    """
    totals = [left + done for left, done in work if left + done > 0]
    done_s = sum(done for _, done in work)
    total_s = sum(totals) * (1 + unknown / len(totals)) if totals else 0.0
    return done_s / total_s if total_s > 0 else 0.0


_ESTIMATE_EVERY_S = 1.0


class EventObserver:
    """An observer of the engine's run that passes everything on, and adds the time left."""

    def __init__(
        self, progress: Progress, clock: Callable[[], float] = time.monotonic, executor: Executor | None = None
    ) -> None:
        self._progress = progress
        self._executor = executor
        self._workers = executor.capacity if executor else 0
        self._clock = clock
        self._estimator = TimeEstimator(clock)
        self._next_estimate_s = clock() + _ESTIMATE_EVERY_S
        self._kernels_before = self._kernels = count_compiled()

    def __call__(self, event: Event | None) -> None:
        """Pass on an event (None: there is none), and once a second compiled kernels, workers and the time left."""
        if event is not None:
            self._pass_on(event)
        now = self._clock()
        if now < self._next_estimate_s:
            return
        since_s = now - self._next_estimate_s + _ESTIMATE_EVERY_S
        self._next_estimate_s = now + _ESTIMATE_EVERY_S
        if (kernels := count_compiled()) > self._kernels:
            self._kernels = kernels
            self._pass_on(KernelsCompiled(kernels - self._kernels_before, round(since_s, 6)))
        if self._executor is not None:
            if (workers := self._executor.places()) != self._workers:
                self._workers = workers
                self._pass_on(WorkersChanged(workers))
            if notice := self._executor.notice():
                self._progress(Warned(notice))
        self._progress(self._estimator.estimate())

    def _pass_on(self, event: Event) -> None:
        self._estimator(event)
        self._progress(event)
