"""The time of a stage, and what observers learn while a run waits."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.planning.units import PENDING, StageState
from pano_mvs.engine.running import run as run_module
from pano_mvs.engine.running.events import Failure, RunEvent, RunResult
from pano_mvs.engine.running.events import ignore as ignore_event
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.running.statistics import RunStatistics
from pano_mvs.scene import Axis
from tests.engine.conftest import Toy


def test_a_stage_takes_the_time_in_which_its_units_are_computed(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stage whose first unit came early and whose last one came late took hours, most of which it waited."""
    now = [0.0]
    monkeypatch.setattr("pano_mvs.engine.running.statistics.time.perf_counter", lambda: now[0])
    entry = toy.session().workflow.stages["scaled"]
    state = StageState(Axis.IMAGE, pending=set("abcd"))

    def ignore(_names: Iterable[str]) -> None:
        pass

    result = RunResult()
    counts = RunStatistics(result, ignore_event, states=lambda _name: state, name_items=ignore)
    counts.stage_opened(entry)

    def at(time_s: float) -> None:
        now[0] = time_s

    record = UnitRecord("k", {}, PENDING, seconds=3.0)
    at(100.0)
    counts.unit_started(entry, "a")
    at(101.0)
    counts.unit_started(entry, "b")
    at(103.0)
    counts.unit_done(entry, "a", record, status="run")
    counts.unit_done(entry, "c", record, status="cached")
    at(104.0)
    counts.unit_done(entry, "b", record, status="run")
    at(200.0)
    counts.unit_started(entry, "d")
    at(202.0)
    counts.unit_failed(Failure("scaled", "d", "why"), 2.0)
    at(500.0)
    counts.stage_complete(entry)
    (summary,) = result.stages
    assert summary.seconds == 4.0 + 2.0
    assert (summary.unit_seconds, summary.slowest_s, summary.run) == (6.0, 3.0, 2)


class Patient(SerialExecutor):
    """Reports that nothing has ended yet, each time before it computes a unit."""

    def __init__(self, store: Store) -> None:
        super().__init__(store, threads=1)
        self.waits: list[float | None] = []

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        if timeout_s == 0:
            return None
        self.waits.append(timeout_s)
        return super().wait(timeout_s) if len(self.waits) % 2 == 0 else None


class Waiting:
    """Counts how often it learns that a run waits."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, event: RunEvent | None) -> None:
        self.count += event is None


def test_an_observer_learns_that_a_run_waits_and_the_run_goes_on(toy: Toy) -> None:
    session, observer = toy.session(), Waiting()
    store = Store(session.store_root)
    executor = Patient(store)
    run = Run(session.workflow, session.graph, store, out=session.out, observer=observer, executor=executor)
    assert run.execute().exit_code == 0
    assert observer.count == len(executor.waits) / 2 > 20
    assert set(executor.waits) == {run_module.WAIT_S}
