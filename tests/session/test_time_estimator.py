"""The estimated time that a run has left, by a clock that stands still unless it is moved."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.running.events import StageFinished, StageStarted, UnitFinished, UnitStarted, UnitStatus
from pano_mvs.session import time_estimator as observer_module
from pano_mvs.session.progress import Event, Forecast, KernelsCompiled, RunFinished, RunStarted, TimeLeft
from pano_mvs.session.time_estimator import Countdown, EventObserver, TimeEstimator


@dataclass
class Clock:
    """A clock that is moved by hand."""

    now: float = 100.0

    def __call__(self) -> float:
        return self.now


class SimulatedRun:
    """A run whose events a test reports."""

    def __init__(self, *stages: StageForecast, workers: int = 1, report_s: float = 0.0, forecast: bool = True) -> None:
        self.clock = Clock()
        self.estimator = TimeEstimator(self.clock)
        names = tuple(stage.stage for stage in stages)
        self.estimator(RunStarted("w", names, "processes", workers=workers, threads=1, out=Path("out")))
        if forecast:
            self.estimator(Forecast(stages, report_s))

    def start(self, stage: str, *items: str, units: int = 0) -> None:
        if units:
            self.estimator(StageStarted(stage, units))
        for item in items:
            self.estimator(UnitStarted(stage, item))

    def finish(self, stage: str, *items: str, seconds: float = 0.0, outcome: UnitStatus = "run") -> None:
        for item in items:
            self.estimator(UnitFinished(stage, item, outcome, seconds))

    def end(self, *stages: str) -> None:
        for stage in stages:
            self.estimator(StageFinished(stage, "x", 1, 1, 0, 0, 0, 0.0, 0.0, {}))

    def left(self, after_s: float = 0.0) -> TimeLeft:
        self.clock.now += after_s
        return self.estimator.estimate()


def stage(name: str, units: int | None, unit_s: float | None, *after: str, cached: int = 0) -> StageForecast:
    return StageForecast(name, after, cached, units, unit_s, 0.0)


def test_before_anything_runs_the_estimate_is_the_forecast() -> None:
    run = SimulatedRun(stage("a", 4, 10.0), stage("b", 1, 30.0, "a"), workers=2, report_s=5.0)
    assert run.left() == TimeLeft(20.0 + 30.0 + 5.0, at_least=False, done=0.0)


def test_it_counts_down_with_the_clock_while_units_take_what_was_expected() -> None:
    run = SimulatedRun(stage("a", 2, 10.0), stage("b", 1, 30.0, "a"))
    run.start("a", "1", units=2)
    assert [run.left(1.0).seconds_left for _ in range(5)] == [49.0, 48.0, 47.0, 46.0, 45.0]
    run.clock.now += 5
    run.finish("a", "1", seconds=10.0)
    run.start("a", "2")
    assert run.left().seconds_left == pytest.approx(40.0)


def test_units_of_this_run_outweigh_the_forecast() -> None:
    run = SimulatedRun(stage("a", 20, 10.0))
    run.start("a", units=20)
    for number in range(10):
        run.start("a", str(number))
        run.clock.now += 2
        run.finish("a", str(number), seconds=2.0)
    assert run.left().seconds_left == pytest.approx(10 * (10.0 * (20 + 10) / (100 + 10) + 20) / 11)
    for number in range(10, 19):
        run.start("a", str(number))
        run.finish("a", str(number), seconds=2.0)
    assert run.left().seconds_left == pytest.approx(2.0, abs=0.4)


def test_a_machine_that_is_slower_than_before_is_so_for_later_stages_too() -> None:
    run = SimulatedRun(stage("a", 1, 100.0), stage("b", 1, 100.0, "a"))
    run.start("a", "1", units=1)
    run.clock.now += 200
    run.finish("a", "1", seconds=200.0)
    run.end("a")
    assert run.left().seconds_left == pytest.approx(100.0 * 210 / 110)


def test_an_overdue_unit_never_leaves_no_time_and_the_estimate_never_stands_still() -> None:
    run = SimulatedRun(stage("a", 1, 10.0), stage("b", 2, 1.0, "a"))
    run.start("a", "1", units=1)
    shown = [run.left(5.0).seconds_left for _ in range(20)]
    assert all(left > 2.0 for left in shown)
    assert all(left != after for left, after in pairwise(shown))


def test_what_nobody_knows_is_a_lower_bound_that_units_fill_in() -> None:
    run = SimulatedRun(stage("a", 4, None), stage("b", None, None, "a"))
    assert run.left() == TimeLeft(0.0, at_least=True, done=0.0, unknown=("a", "b"))
    run.start("a", "1", units=4)
    left = run.left(10.0)
    assert (left.at_least, left.unknown) == (True, ("b",))
    assert left.seconds_left == pytest.approx(10 + 3 * 20), "the unit is expected to take as long again"
    run.finish("a", "1", seconds=12.0)
    assert run.left().seconds_left == pytest.approx(36.0)
    run.start("b", "1", units=2)
    run.left(1.0)
    run.finish("b", "1", seconds=1.0)
    left = run.left()
    assert (left.at_least, left.unknown) == (False, ())
    assert left.seconds_left == pytest.approx(37.0), "stages may overlap"
    assert left.done == pytest.approx(13 / 50)


def test_it_is_never_empty_while_a_unit_runs_even_without_any_forecast() -> None:
    run = SimulatedRun(stage("a", None, None), forecast=False)
    run.start("a", "1", units=1)
    assert [run.left(10.0).seconds_left for _ in range(3)] == [10.0, 20.0, 30.0]


def test_cached_units_cost_nothing_and_are_not_expected_to() -> None:
    run = SimulatedRun(stage("a", 2, 10.0, cached=8))
    run.start("a", units=10)
    assert run.left().seconds_left == 20.0
    run.finish("a", *map(str, range(8)), outcome="cached")
    assert run.left().seconds_left == 20.0
    run.start("a", "8")
    assert run.left(10.0).seconds_left == pytest.approx(2.0 + 10.0)


def test_units_that_should_have_been_cached_count_once_the_forecast_is_refuted() -> None:
    run = SimulatedRun(stage("a", 1, 10.0, cached=3))
    run.start("a", "0", "1", units=4)
    assert run.left().seconds_left == pytest.approx(40.0)


def test_failed_units_count_as_computed_and_blocked_ones_as_done() -> None:
    run = SimulatedRun(stage("a", 4, 10.0))
    run.start("a", "0", units=4)
    run.clock.now += 10
    run.finish("a", "0", seconds=10.0, outcome="failed")
    run.finish("a", "1", "2", outcome="blocked")
    assert run.left().seconds_left == pytest.approx(10.0)


def test_fewer_units_at_a_time_than_workers_take_longer() -> None:
    """Memory may permit only two sweeps at a time, whatever the number of workers."""
    run = SimulatedRun(stage("a", 8, 10.0), workers=8)
    assert run.left().seconds_left == 10.0
    run.start("a", "0", "1", units=8)
    run.clock.now += 10
    run.finish("a", "0", "1", seconds=10.0)
    run.start("a", "2", "3")
    assert run.left().seconds_left == pytest.approx(30.0)


def test_the_bar_counts_work_and_never_goes_back() -> None:
    run = SimulatedRun(stage("a", 100, 0.1), stage("b", 1, 90.0, "a"))
    run.start("a", units=100)
    for number in range(100):
        run.start("a", str(number))
        run.clock.now += 0.1
        run.finish("a", str(number), seconds=0.1)
    run.end("a")
    assert run.left().done == pytest.approx(0.1), "a hundred units of 101 are a tenth of the work"
    run.start("b", "", units=1)
    done = [run.left(30.0).done for _ in range(6)]
    assert done == sorted(done)
    assert done[-1] < 1.0
    run.estimator(RunFinished(exit_code=0, stopped=""))
    assert run.left() == TimeLeft(0.0, at_least=False, done=1.0)


def test_the_start_of_a_worker_is_not_work() -> None:
    """A bar that ran ahead while workers started stood still for as long afterwards."""
    run = SimulatedRun(stage("a", 1, 0.1), stage("b", 1, 99.9, "a"))
    run.start("a", "", units=1)
    assert run.left(9.0).done == pytest.approx(0.1 / 101.8)
    run.finish("a", "", seconds=0.1)
    run.start("b", "", units=1)
    assert run.left(10.0).done > 0.09


def test_compiling_kernels_does_not_make_a_stage_slow() -> None:
    run = SimulatedRun(stage("a", 4, 10.0))
    run.start("a", "1", units=4)
    assert run.left(60.0).seconds_left > 100
    run.estimator(KernelsCompiled(12, seconds=60.0))
    assert run.left().seconds_left == pytest.approx(40.0)
    assert run.left(4.0).seconds_left == pytest.approx(36.0)


def test_stages_that_a_limited_run_does_not_have_are_not_waited_for() -> None:
    """With `--until`, the time left stayed a lower bound, as nothing was known of the stages after it."""
    run = SimulatedRun(stage("a", 1, 4.0), stage("b", 1, None, "a"), forecast=False)
    run.estimator(Forecast((stage("a", 1, 4.0),), report_s=2.0))
    assert run.left() == TimeLeft(6.0, at_least=False, done=0.0)
    run.end("a")
    assert run.estimator.is_reporting


@pytest.mark.parametrize("known_before", [True, False])
def test_while_kernels_are_to_be_compiled_the_estimate_is_a_lower_bound(known_before: bool) -> None:
    """With no kernel compiled yet, the progress said "about 8 s left" for 138 s."""
    stages = stage("a", 2, 4.0), stage("b", 1, 4.0, "a"), stage("c", 0, 4.0, "b")
    run = SimulatedRun(*stages, forecast=False)
    run.estimator(Forecast(stages, compiles=known_before))
    if not known_before:  # some kernels are there, but not all
        assert not run.left().at_least
        run.estimator(KernelsCompiled(1, seconds=1.0))
    assert (run.left().at_least, run.left().compiles, run.left().unknown) == (True, True, ())
    run.start("a", "1", units=2)
    run.finish("a", "1", seconds=4.0)
    assert run.left().compiles, "b has kernels of its own"
    run.start("b", "", units=1)
    run.finish("b", "", seconds=4.0)
    assert (run.left().at_least, run.left().compiles) == (False, False)


def test_unknown_stages_weigh_like_the_others_in_the_bar() -> None:
    run = SimulatedRun(stage("a", 1, 10.0), stage("b", None, None, "a"))
    run.start("a", "", units=1)
    assert run.left(5.0).done == pytest.approx(0.25)


def test_the_report_is_part_of_the_run() -> None:
    run = SimulatedRun(stage("a", 1, 10.0), report_s=8.0)
    run.start("a", "", units=1)
    run.clock.now += 10
    run.finish("a", "", seconds=10.0)
    run.end("a")
    assert run.estimator.is_reporting
    assert [run.left(2.0).seconds_left for _ in range(3)] == [6.0, 4.0, 2.0]
    assert run.left(20.0).seconds_left > 0


def test_a_run_that_starts_over_counts_its_stages_again() -> None:
    run = SimulatedRun(stage("a", 2, 10.0))
    run.start("a", "0", units=2)
    run.finish("a", "0", "1", seconds=10.0)
    run.end("a")
    assert run.left().seconds_left == 0.0
    run.start("a", units=2)
    assert run.left().seconds_left == pytest.approx(20.0)


def test_the_time_of_a_stage_is_its_own() -> None:
    run = SimulatedRun(stage("a", 3, 1.0))
    a = run.estimator.stages["a"]
    run.start("a", units=3)
    run.clock.now += 50  # it waits for others
    run.start("a", "0")
    a = run.estimator.stages["a"]
    run.clock.now += 1
    run.start("a", "1")
    run.clock.now += 2
    run.finish("a", "0")
    run.clock.now += 1
    run.finish("a", "1")
    run.clock.now += 50
    assert a.own_s(run.clock.now) == 4.0
    run.start("a", "2")
    run.clock.now += 2
    assert a.own_s(run.clock.now) == 6.0


def test_a_countdown_glides_to_a_new_estimate_without_a_jump() -> None:
    countdown = Countdown()
    assert countdown.show(100.0, 0.0) == 100.0
    assert countdown.show(99.0, 1.0) == pytest.approx(99.0), "with the clock"
    shown = [countdown.show(200.0, 1.0 + 0.25 * step) for step in range(1, 80)]
    assert max(abs(after - before) for before, after in pairwise(shown)) < 8
    assert shown == sorted(shown)
    assert shown[-1] == pytest.approx(200.0, abs=5)
    assert countdown.show(200.0, 1.0 + 0.25 * 79) == shown[-1], "nothing changes while the clock stands"
    assert Countdown().show(-1.0, 0.0) == 0.0


def test_the_time_left_is_reported_once_a_second_beside_other_events(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observer_module, "count_compiled", lambda: 0)  # other processes may be compiling
    clock, events = Clock(), list[Event]()
    observer = EventObserver(events.append, clock)
    observer(RunStarted("w", ("a",), "processes", workers=1, threads=1, out=Path("out")))
    observer(Forecast((stage("a", 2, 10.0),)))
    observer(StageStarted("a", 2))
    observer(UnitStarted("a", "1"))
    assert not [event for event in events if isinstance(event, TimeLeft)]
    clock.now += 5
    observer(None)
    observer(None)
    assert events[-1] == TimeLeft(15.0, at_least=False, done=0.25)
    clock.now += 5
    observer(UnitFinished("a", "1", "run", 10.0))
    assert [type(event) for event in events[-3:]] == [TimeLeft, UnitFinished, TimeLeft]


def test_kernels_that_are_compiled_meanwhile_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = [7, 7, 9]
    monkeypatch.setattr(observer_module, "count_compiled", lambda: compiled.pop(0))
    clock, events = Clock(), list[Event]()
    observer = EventObserver(events.append, clock)
    clock.now += 5
    observer(None)
    clock.now += 3
    observer(None)
    assert [event for event in events if isinstance(event, KernelsCompiled)] == [KernelsCompiled(2, seconds=3.0)]
