"""What a run does before, between and after its passes: warnings, interrupts, repairs, and what the next run knows."""

from __future__ import annotations

import pytest

from pano_mvs.core.errors import InputError, RunStoppedError, StoreError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.planning.plan import RunOptions
from pano_mvs.engine.running import run as module
from pano_mvs.engine.running.events import Observer, RunEvent, RunResult, Warned, ignore
from pano_mvs.engine.running.run import Run
from pano_mvs.scene import Pairs, Record
from tests.engine.conftest import Toy
from tests.engine.running.test_run_pass import Shelf, run_with, shelf

__all__ = ["shelf"]  # a fixture


class Warnings:
    """Notes the warnings."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def __call__(self, event: RunEvent | None) -> None:
        if isinstance(event, Warned):
            self.texts.append(event.text)


class Interrupted(Shelf):
    """Is interrupted when several units are running; they end afterwards, except for so many.

    Attributes:
        hanging: number of units that do not end.
        cancelled: whether all units were ended.
    """

    def __init__(self, store: Store) -> None:
        super().__init__(store)
        self.hanging = 0
        self.cancelled = False
        self._was_interrupted = False

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        if len(self._jobs) > 3 and not self._was_interrupted:
            self._was_interrupted = True
            raise KeyboardInterrupt
        if self._was_interrupted and len(self._jobs) <= self.hanging:
            return None
        return super().wait(timeout_s)

    def cancel(self) -> None:
        self.cancelled = True
        super().cancel()


def make_run(toy: Toy, shelf: Shelf, observer: Observer, *overrides: str) -> Run:
    session = toy.session(*overrides)
    store = Store(session.store_root)
    return Run(session.workflow, session.graph, store, out=session.out, executor=shelf, observer=observer)


def remembered(toy: Toy) -> dict[str, set[str]]:
    """Return stage to the units whose keys the next run knows."""
    keys = Store(toy.folder / "cache").runs.last_keys(toy.session().workflow.id)
    return {stage: set(units) for stage, units in keys.items()}


@pytest.mark.parametrize(
    ("override", "enforces", "count"),
    [("scaled.timeout_s=5", False, 1), ("scaled.timeout_s=5", True, 0), ("scaled.timeout_s=0", False, 0)],
)
def test_timeouts_without_effect_are_warned_of(
    toy: Toy, shelf: Shelf, override: str, enforces: bool, count: int
) -> None:
    shelf.enforces_timeouts = enforces
    warned = Warnings()
    result = make_run(toy, shelf, warned, override, "mean.timeout_s=0").execute()
    texts = [
        "timeout_s of scaled has no effect: a unit that runs in the main process cannot be ended. "
        "Use --executor processes"
    ] * count
    assert (result.warnings, warned.texts) == (texts, texts)


@pytest.mark.parametrize("hanging", [0, 2])
def test_an_interrupted_run_lets_running_units_end(toy: Toy, monkeypatch: pytest.MonkeyPatch, hanging: int) -> None:
    """They are given some time, and what ends within it is in the cache."""
    monkeypatch.setattr(module, "GRACE_S", 0.2 if hanging else 600.0)
    interrupted = Interrupted(Store(toy.folder / "cache"))
    interrupted.enforces_timeouts, interrupted.hanging = True, hanging
    warned = Warnings()
    run = make_run(toy, interrupted, warned)
    with pytest.raises(KeyboardInterrupt):
        run.execute()
    assert run.result.stopped == "interrupted"
    (text,) = warned.texts
    assert text.startswith("interrupted: 4 units may finish within ")
    assert interrupted.cancelled
    assert not run.dispatcher
    assert len(list((toy.folder / "cache" / "records").rglob("*.json"))) == 4 - hanging
    assert remembered(toy)["images"] == {"1.txt", "2.txt", "3.txt", "4.txt"}


def test_units_in_this_process_are_not_waited_for_after_an_interrupt(toy: Toy) -> None:
    interrupted, warned = Interrupted(Store(toy.folder / "cache")), Warnings()
    with pytest.raises(KeyboardInterrupt):
        make_run(toy, interrupted, warned).execute()
    assert warned.texts == []
    assert interrupted.cancelled


def test_what_is_damaged_again_after_each_repair_ends_the_run(toy: Toy, shelf: Shelf) -> None:
    shelf.answers["scaled:4.txt"] = JobOutcome("damaged", cause="blob x is damaged")
    warned = Warnings()
    with pytest.raises(StoreError, match="blob x is damaged again and again: check the disk, or choose another cache"):
        make_run(toy, shelf, warned).execute()
    assert warned.texts == ["blob x is damaged"] * 4


def test_values_of_a_run_are_loaded_by_stage_and_item(toy: Toy, shelf: Shelf) -> None:
    run = make_run(toy, shelf, ignore)
    run.execute()
    pairs = run.load("pairs", Pairs)
    assert isinstance(pairs, Pairs)
    assert len(pairs.pairs) == 4
    kind: type[Record] = run.workflow.stages["scaled"].spec.output
    assert getattr(run.load("scaled", kind, "2.txt"), "value", None) == 60
    assert run.load("scaled", kind, "9.txt") is None
    assert run.load("nothing", kind) is None


def test_a_run_that_ends_forgets_the_units_that_are_no_more(finished: Toy, shelf: Shelf) -> None:
    """Also with failed units; one that was stopped, or that was a part, has not reached the others."""
    everything = {f"{number}.txt" for number in range(1, 6)}
    (finished.folder / "capture" / "5.txt").unlink()
    assert run_with(finished, shelf, "scaled.gate={value: {max: 1}}").exit_code == RunStoppedError.exit_code
    assert remembered(finished)["images"] == everything
    session = finished.session()
    Run(
        session.workflow,
        session.graph,
        Store(session.store_root),
        out=session.out,
        executor=shelf,
        options=RunOptions(until=("scaled",)),
    ).execute()
    assert remembered(finished)["images"] == everything
    finished.number("2.txt", "13")
    assert run_with(finished, shelf).exit_code == 3
    assert remembered(finished)["images"] == everything - {"5.txt"}
    assert remembered(finished)["scaled"] == everything - {"5.txt"}


def test_a_run_without_failures_forgets_them_too(finished: Toy, shelf: Shelf) -> None:
    (finished.folder / "capture" / "5.txt").unlink()
    assert run_with(finished, shelf).exit_code == 0
    assert "5.txt" not in remembered(finished)["images"]


def test_an_error_forgets_nothing(finished: Toy, shelf: Shelf) -> None:
    """A disk that was full, or not there, let a later collection delete the results of the run before."""
    everything = remembered(finished)
    shelf.answers["scaled:1.txt"] = JobOutcome("stopped", cause="the disk is full", error="StoreError")
    with pytest.raises(StoreError, match="the disk is full"):
        run_with(finished, shelf, "scaled.by=4")
    assert remembered(finished) == everything
    for number in range(1, 6):
        finished.number(f"{number}.txt", "not a number")
    with pytest.raises(InputError, match="none of the 5 items can be used"):
        run_with(finished, shelf)
    assert remembered(finished) == everything


def test_files_of_earlier_runs_are_removed_or_named(toy: Toy, shelf: Shelf) -> None:
    def result_of(*overrides: str) -> RunResult:
        return make_run(toy, shelf, ignore, *overrides).execute(earlier_files=first.published)

    first = toy.run()
    assert first.written == sorted(first.published) != []
    (toy.folder / "capture" / "5.txt").unlink()
    stopped = result_of("mean.gate={nothing: {max: 1}}")
    assert (stopped.removed, sorted(stopped.left_over)) == ([], sorted(first.published))
    (toy.folder / "out" / "mean" / "1.txt").unlink()
    again = result_of()
    assert again.removed == ["mean/5.txt"]
    assert not (toy.folder / "out" / "mean" / "5.txt").exists()
    assert again.left_over == {}
    assert again.written == sorted(again.written)
    assert "mean/1.txt" in again.written
