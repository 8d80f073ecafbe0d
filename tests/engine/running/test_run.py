"""A run from its beginning to its end: what is computed, what is kept, what its options change, and how it goes on."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.core.errors import InputError, RunStoppedError, StoreError, UsageError, WorkflowError
from pano_mvs.core.files import remove_whole
from pano_mvs.engine.cache.latest_runs import RunHistory
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors import execute
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.planning.plan import RunOptions, make_plan
from pano_mvs.engine.running import run as module
from pano_mvs.engine.running.events import Observer, RunEvent, RunResult, StageFinished, Warned, ignore
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.stages import stage_code
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.scene import Pairs, Record
from pano_mvs.session.running import Execution, run_session
from tests.engine.conftest import PATIENCE_S, Toy, finished_records, ran, start
from tests.engine.running.test_run_pass import Shelf, run_with, shelf
from tests.engine.workflows.test_wiring import MORE

ALL_UNITS = {
    "images": 5,
    "scaled": 5,
    "pairs": 1,
    "difference": 4,
    "shifted": 1,
    "views": 1,
    "mean": 5,
    "each": 5,
    "all": 1,
}


def test_first_run_computes_every_unit_and_the_second_none(toy: Toy) -> None:
    first = toy.run()
    assert ran(first) == ALL_UNITS
    assert first.exit_code == 0
    before = toy.deliverables()
    second = toy.run()
    assert second.computed == 0
    assert second.units["cached"] == sum(ALL_UNITS.values())
    assert second.written == []
    assert toy.deliverables() == before


def test_values_flow_through_every_cardinality(finished: Toy) -> None:
    files = finished.deliverables()
    assert files["mean/1.txt"] == b"45.0"  # (30 + 60) / 2
    assert files["mean/3.txt"] == b"90.0"
    assert b"(('1.txt', '2.txt'), 30.0)" in files["all.txt"]
    assert b"'1.txt': -60.0" in files["all.txt"]


@pytest.mark.slow
def test_a_stage_for_every_image_loses_none_of_them(toy: Toy) -> None:
    """Images without neighbours, and those whose own item failed, pass through; a unit depends on its neighbours."""
    toy.edit("plug.py", lambda text: text + MORE)
    line = "  around:     {use: toy.around, in: {x: images, near: scaled}}\n"
    toy.edit(
        "wf.yaml", lambda text: text.replace("by: 3}", "by: 3, on_error: skip}").replace("  mean: ", f"{line}  mean: ")
    )
    toy.edit(
        "wf.yaml", lambda text: text.replace("in: {own: scaled, around: scaled}", "in: {own: around, around: around}")
    )
    toy.number("3.txt", "13")
    result = toy.run()
    assert ran(result)["around"] == ran(result)["mean"] == 5
    files = toy.deliverables()
    around = [10 + 9, 20 + 9, 13 + 6 + 12, 40 + 27, 50 + 27]  # a tenth of own and neighbours; 3.txt has no own
    assert float(files["mean/1.txt"]) == (around[0] + around[1]) / 2
    assert float(files["mean/3.txt"]) == (around[1] + around[2] + around[3]) / 3
    toy.number("5.txt", "51")
    assert ran(toy.run())["around"] == 2


def test_touching_one_item_runs_exactly_what_depends_on_it(finished: Toy) -> None:
    finished.number("3.txt", "31")
    plan = finished.plan()
    assert list(plan["images"].run) == ["3.txt"]
    assert plan["images"].run["3.txt"] == "input 3.txt"
    assert set(plan["mean"].may_run) == {"2.txt", "3.txt", "4.txt"}
    assert set(plan["mean"].cached) == {"1.txt", "5.txt"}
    expected = {"images": 1, "scaled": 1, "difference": 2, "shifted": 1, "mean": 3, "each": 3, "all": 1}
    assert ran(finished.run()) == expected


def test_same_value_from_other_bytes_cuts_off_early(finished: Toy) -> None:
    finished.number("3.txt", "30.000")
    assert ran(finished.run()) == {"images": 1}


def test_touching_without_changing_runs_nothing(finished: Toy) -> None:
    finished.number("3.txt", "30")
    assert finished.run().computed == 0


def test_adding_an_item_runs_its_units_and_those_beside_it(finished: Toy) -> None:
    finished.number("6.txt", "60")
    counts = ran(finished.run())
    assert counts == {
        "images": 1,
        "scaled": 1,
        "pairs": 1,
        "difference": 1,
        "shifted": 1,
        "views": 1,
        "mean": 2,
        "each": 2,
        "all": 1,
    }


def test_moving_and_renaming_recomputes_only_what_sees_names(finished: Toy) -> None:
    shutil.move(finished.folder / "capture", finished.folder / "elsewhere")
    finished.edit("wf.yaml", lambda text: text.replace("path: capture", "path: elsewhere"))
    assert finished.run().computed == 0
    (finished.folder / "elsewhere" / "5.txt").rename(finished.folder / "elsewhere" / "5b.txt")
    assert ran(finished.run()) == {"images": 1, "pairs": 1, "views": 1, "shifted": 1, "all": 1}


def test_setting_changes_run_from_there_on_and_the_plan_says_why(finished: Toy) -> None:
    plan = finished.plan("scaled.by=7")
    assert set(plan["scaled"].run.values()) == {"param by 3.0 → 7.0"}
    assert plan["images"].run == {}
    counts = ran(finished.run("scaled.by=7"))
    assert counts == {"scaled": 5, "difference": 4, "shifted": 1, "mean": 5, "each": 5, "all": 1}
    assert finished.run().computed == 0, "the first setting's results are still there"


def test_plugin_is_cached_by_its_code_and_that_of_its_helper(finished: Toy) -> None:
    finished.edit("plug.py", lambda text: "# a comment\n" + text.replace('"""Multiply."""', '"""Multiply, as ever."""'))
    assert finished.run().computed == 0, "comments and docstrings are free"
    finished.edit("helper.py", lambda text: text.replace("2 * x", "x + x"))
    plan = finished.plan()
    assert "code" in plan["images"].run["1.txt"]
    assert "plug.py" in plan["images"].run["1.txt"]
    assert ran(finished.run())["scaled"] == 5


def test_deleted_and_edited_deliverables_are_written_again_from_the_store(finished: Toy) -> None:
    before = finished.deliverables()
    (finished.folder / "out" / "all.txt").unlink()
    (finished.folder / "out" / "mean" / "2.txt").write_text("vandalism")
    result = finished.run()
    assert result.computed == 0
    assert sorted(result.written) == ["all.txt", "mean/2.txt"]
    assert finished.deliverables() == before | {"mean/2.txt.bak": b"vandalism"}


def test_deliverables_of_removed_items_go_but_edited_ones_stay(toy: Toy) -> None:
    first = toy.run()
    (toy.folder / "out" / "mean" / "4.txt").write_text("my own notes")
    (toy.folder / "capture" / "4.txt").unlink()
    (toy.folder / "capture" / "5.txt").unlink()
    result = toy.run(earlier=dict(first.published))
    assert result.removed == ["mean/5.txt"]
    assert (toy.folder / "out" / "mean" / "4.txt").read_text() == "my own notes"


def test_one_failing_item_does_not_end_the_run(toy: Toy) -> None:
    toy.number("3.txt", "13")
    result = toy.run()
    assert result.exit_code == 3
    failure = result.failures[0]
    assert (failure.stage, failure.item) == ("scaled", "3.txt")
    assert "thirteen is unlucky" in failure.cause
    assert f"{toy.folder / 'plug.py'}:" in failure.cause, "the plugin's own line is named"
    files = toy.deliverables()
    assert "mean/2.txt" in files
    assert "mean/3.txt" not in files
    blocked = {(f.stage, f.item) for f in result.blocked}
    assert ("mean", "3.txt") in blocked
    assert ("each", "3.txt") in blocked
    toy.number("3.txt", "30")
    again = toy.run()
    assert again.exit_code == 0
    assert toy.deliverables()["mean/3.txt"] == b"90.0"


def test_failed_unit_is_tried_again(toy: Toy) -> None:
    toy.number("3.txt", "13")
    toy.run()
    assert [f.item for f in toy.run().failures if f.stage == "scaled"] == ["3.txt"]


def test_on_error_stop_and_gates_stop_with_exit_code_4(toy: Toy) -> None:
    toy.number("3.txt", "13")
    assert toy.run("scaled.on_error=stop").exit_code == RunStoppedError.exit_code
    assert "unlucky" in toy.run("scaled.on_error=stop").stopped
    assert toy.run("scaled.min_success=0.9").exit_code == RunStoppedError.exit_code
    gated = toy.run("scaled.gate={value: 1000}")
    assert gated.exit_code == RunStoppedError.exit_code
    assert "`gate` requires 1000" in gated.stopped
    assert "the stage reports: value" in toy.run("scaled.gate={valu: 1}").stopped


def test_what_does_not_depend_on_a_stage_that_stops_the_run_is_computed(toy: Toy) -> None:
    """Where matches join no two panoramas, the links of a tour still say where they stand."""
    stop = 'from pano_mvs.api import RunStoppedError\nraise RunStoppedError("nothing to show")'
    toy.begin(stop, of="Consecutive pairs.")
    result = toy.run()
    assert (result.exit_code, result.stopped) == (RunStoppedError.exit_code, "nothing to show")
    assert sorted(result.published) == [f"mean/{number}.txt" for number in range(1, 6)]
    assert not result.failures
    assert result.warnings == ["pairs stops the run; what does not depend on it is still computed"]
    # A second reason to stop does not hide the first one.
    toy.begin(stop.replace("nothing to show", "nothing to add"), of="Less the whole part of the mean.")
    again = toy.run("shifted.gate={nothing: 1}", "mean.gate={nothing: {max: 1}}")
    assert again.exit_code == RunStoppedError.exit_code
    assert again.stopped in {"nothing to show", "nothing to add"}


def test_one_of_many_units_that_stops_the_run_stops_it_at_once(toy: Toy) -> None:
    toy.begin('from pano_mvs.api import RunStoppedError\nraise RunStoppedError("enough")')
    result = toy.run()
    assert (result.exit_code, result.stopped, list(result.published)) == (RunStoppedError.exit_code, "enough", [])


def test_empty_source_of_failures_only_is_an_input_error(toy: Toy) -> None:
    for number in range(1, 6):
        toy.number(f"{number}.txt", "not a number")
    with pytest.raises(InputError, match="none of the 5 items"):
        toy.run()


def test_two_stores_in_different_folders_give_the_same_bytes(finished: Toy, tmp_path: Path) -> None:
    before = finished.deliverables()
    shutil.rmtree(finished.folder / "out")
    result = finished.run(cache=tmp_path / "another")
    assert ran(result) == ALL_UNITS
    assert finished.deliverables() == before


def test_stages_that_write_one_file_are_told_so(toy: Toy) -> None:
    toy.edit("wf.yaml", lambda text: text + "  again:      {use: toy.write, to: .}\n")
    with pytest.raises(UsageError, match=r"'all' and 'again' both write all\.txt"):
        toy.run()
    toy.edit("wf.yaml", lambda text: text.replace("to: .", "to: second"))
    toy.run()
    assert "second/all.txt" in toy.deliverables()


def test_output_folder_that_cannot_be_made_is_an_error(toy: Toy) -> None:
    (toy.folder / "out").write_text("a file is in the way")
    with pytest.raises(UsageError, match="Choose another folder with --out"):
        toy.run()


def test_plan_of_an_empty_store_runs_the_source_and_waits_for_the_rest(toy: Toy) -> None:
    plan = toy.plan()
    assert set(plan["images"].run.values()) == {"new"}
    assert len(plan["scaled"].may_run) == 5
    assert plan["difference"].open
    assert plan["mean"].open


def test_files_of_an_image_that_failed_meanwhile_are_not_forgotten(toy: Toy) -> None:
    first = toy.run()
    (toy.folder / "capture" / "5.txt").unlink()
    toy.number("2.txt", "not a number")
    failed = toy.run(earlier=dict(first.published))
    assert set(failed.left_over) == {"mean/2.txt"}
    assert failed.removed == ["mean/5.txt"], "its image is gone, whatever failed"
    toy.number("2.txt", "20")
    mended = toy.run(earlier={**failed.published, **failed.left_over})
    assert mended.removed == []
    assert "mean/2.txt" in mended.published


def test_names_that_meet_after_the_extension_is_dropped_stay_apart(toy: Toy) -> None:
    for name in ("a.txt", "a.b.txt", "a.b.txt.txt"):
        toy.number(name, "1")
    toy.run()
    names = {name for name in toy.deliverables() if name.startswith("mean/a")}
    assert len(names) == 3


def test_store_that_cannot_be_written_still_serves_what_it_has(finished: Toy, monkeypatch: pytest.MonkeyPatch) -> None:

    def refuse(*_: object, **__: object) -> None:
        raise StoreError("read only")

    monkeypatch.setattr(RunHistory, "remember", refuse)
    result = finished.run()
    assert result.exit_code == 0
    assert any("cannot give the reasons" in warning for warning in result.warnings)


def test_metric_that_is_not_finite_passes_no_gate(toy: Toy) -> None:
    toy.edit("plug.py", lambda text: text.replace('ctx.metric("value", x.value)', 'ctx.metric("value", float("nan"))'))
    assert toy.run("scaled.gate={value: 1}").exit_code == RunStoppedError.exit_code


def test_the_mean_of_huge_metrics_is_finite(toy: Toy) -> None:
    """Their sum is not, and run.json cannot hold infinity."""
    toy.begin("ctx.metric('huge', 1.7e308); ctx.metric('both', 1.7e308 if x.value < 30 else -1.7e308)")
    output = run_session(toy.session(), Execution(executor="serial"))
    (scaled,) = (stage for stage in output.summary.stages if stage.name == "scaled")
    assert scaled.metrics["huge"] == 1.7e308
    assert scaled.metrics["both"] == pytest.approx(-0.34e308)


def test_a_note_says_how_many_units_gave_it(toy: Toy) -> None:
    """Notes of several units spoke of "some images"."""
    noted = """ctx.note("{count} are dark") if x.value > 25 else ctx.note("a {count} in braces")
    ctx.metric("value", x.value)"""
    toy.edit("plug.py", lambda text: text.replace('ctx.metric("value", x.value)', noted))
    for _ in range(2):
        notes = {stage.stage: stage.notes for stage in toy.run().stages}
        assert sorted(notes["scaled"]) == ["3 of 5 are dark", "a {count} in braces"]


@pytest.mark.parametrize("where", ["    if x.value == 13:", "class ScaleParams"])
def test_plugin_that_exits_is_a_failure(toy: Toy, where: str) -> None:
    indent = where[: len(where) - len(where.lstrip())]
    toy.edit("plug.py", lambda text: text.replace(where, f"{indent}import sys; sys.exit(0)\n{where}"))
    if indent:
        assert toy.run().exit_code == 3
    else:
        with pytest.raises(WorkflowError, match="SystemExit"):
            toy.run()


def test_helpers_of_one_plugin_are_not_those_of_another(toy: Toy) -> None:
    for name, value in (("first", 1), ("second", 50)):
        (toy.folder / name).mkdir()
        (toy.folder / name / "settings.py").write_text(f"VALUE = {value}\n")
        (toy.folder / name / "plugin.py").write_text(
            "from pano_mvs.api import *\nfrom settings import VALUE\n"
            f"@stage('{name}.pairs')\ndef pairs(names: Names[Panorama]) -> Pairs:\n    return VALUE\n"
        )
    registry = Registry()
    for name in ("first", "second"):
        registry.add_file(toy.folder / name / "plugin.py")
    values: list[object] = [registry.stages[f"{name}.pairs"].function(()) for name in ("first", "second")]
    assert values == [1, 50]


def test_stage_that_a_plugin_only_imports_is_not_its_own(toy: Toy) -> None:
    toy.edit("plug.py", lambda text: "from pano_mvs.stages.views import nearest\n" + text)
    session = toy.session()
    assert session.registry.stages["views.nearest"].code_digest == ""


def test_output_that_is_removed_during_the_run_is_written_again(toy: Toy) -> None:
    """A run whose output folder was removed said that all was well, and the next one set its report aside."""

    def remover(event: RunEvent | None) -> None:
        """Remove the output folder once, when some of its files are there."""
        if isinstance(event, StageFinished) and event.stage == "each" and not (toy.folder / "gone").exists():
            (toy.folder / "out").rename(toy.folder / "gone")

    toy.run()
    expected = toy.deliverables()
    remove_whole(toy.folder / "out")
    session = toy.session(cache=toy.folder / "other")
    run = Run(session.workflow, session.graph, Store(session.store_root), out=session.out, observer=remover)
    result = run.execute()
    assert result.exit_code == 0
    assert toy.deliverables() == expected
    assert any("was removed during the run; writing it again" in text for text in result.warnings)
    assert len(result.written) == len(set(result.written))


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


def test_a_part_of_another_capture_has_its_own_units_alone(finished: Toy, shelf: Shelf) -> None:
    """Into another folder with the same cache; the results of the run were those of both captures."""
    for number in range(1, 6):
        (finished.folder / "capture" / f"{number}.txt").unlink()
    finished.number("other.txt", "7")
    session = finished.session()
    Run(
        session.workflow,
        session.graph,
        Store(session.store_root),
        out=session.out.with_name("other"),
        executor=shelf,
        options=RunOptions(until=("scaled",)),
    ).execute()
    assert remembered(finished)["images"] == {"other.txt"}


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


EXEMPT = {"run.json", "report.html", "logs"}
BEFORE_MEANS = 5 + 5 + 1 + 4 + 1 + 1
"""The units of the stages above the means."""


def deliverables(toy: Toy) -> dict[str, bytes]:
    return {name: data for name, data in toy.deliverables().items() if name.split("/")[0] not in EXEMPT}


def hold_means(toy: Toy) -> Path:
    """Let means begin, and then wait as long as the file exists that is returned; each that waits leaves a mark."""
    hold = toy.folder / "hold"
    hold.touch()
    toy.begin(
        f"""
import pathlib
hold = pathlib.Path({str(hold)!r})
if hold.exists(): hold.with_name(f"waits-{{own.value}}").touch()
while hold.exists(): time.sleep(0.01)
""",
        of="Mean of the neighbours and the own.",
    )
    return hold


def wait_for_means(toy: Toy, process: subprocess.Popen[str], count: int) -> None:
    """Wait until so many means wait."""
    deadline = time.monotonic() + PATIENCE_S
    while len(list(toy.folder.glob("waits-*"))) < count:
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_killed_run_resumes_with_the_unfinished_units_only(toy: Toy, tmp_path: Path) -> None:
    hold = hold_means(toy)
    hold.unlink()
    toy.run(cache=tmp_path / "clean")
    clean = deliverables(toy)
    for path in sorted((toy.folder / "out").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    hold.touch()
    process = start(toy)
    wait_for_means(toy, process, 1)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    kept = finished_records(toy)
    assert kept == BEFORE_MEANS
    hold.unlink()
    resumed = start(toy)
    output = "".join(resumed.communicate(timeout=PATIENCE_S))
    assert resumed.returncode == 0, output
    assert f"{28 - kept} units computed, {kept} cached" in output
    assert deliverables(toy) == clean


@pytest.mark.slow
def test_interrupt_ends_with_exit_code_130_and_says_how_to_go_on(toy: Toy) -> None:
    hold_means(toy)
    process = start(toy)
    wait_for_means(toy, process, 1)
    process.send_signal(signal.SIGINT)
    output = "".join(process.communicate(timeout=PATIENCE_S))
    assert process.returncode == 130
    assert "run the same command again" in output


def backups(toy: Toy) -> dict[str, bytes]:
    return {path.relative_to(toy.folder / "out").as_posix(): path.read_bytes() for path in toy.folder.rglob("*.bak")}


def written_file(toy: Toy) -> Path:
    return next(toy.folder / "out" / name for name in sorted(toy.deliverables()) if not name.startswith("."))


def test_an_edited_deliverable_is_written_anew_and_the_edit_is_kept(finished: Toy) -> None:
    path = written_file(finished)
    ours = path.read_bytes()
    for edit in (b"by hand", b"by hand again"):
        path.write_bytes(edit)
        result = finished.run()
        assert result.computed == 0
        assert path.read_bytes() == ours
        assert any(f"{path.name} was not as a run had written it" in warning for warning in result.warnings)
    assert sorted(backups(finished).values()) == [b"by hand", b"by hand again"]


def test_files_of_somebody_else_are_kept(finished: Toy) -> None:
    name = written_file(finished).relative_to(finished.folder / "out")
    (finished.folder / "out").rename(finished.folder / "first")
    path = finished.folder / "out" / name
    path.parent.mkdir(parents=True)
    path.write_bytes(b"of somebody else")
    finished.run()
    assert path.read_bytes() == (finished.folder / "first" / name).read_bytes()
    assert backups(finished) == {f"{name.as_posix()}.bak": b"of somebody else"}


def test_what_runs_wrote_leaves_no_copies(finished: Toy) -> None:
    before = finished.deliverables()
    finished.run("scaled.by=5")
    assert finished.deliverables() != before
    finished.run()
    assert finished.deliverables() == before
    assert not backups(finished)


def run(toy: Toy, options: RunOptions) -> RunResult:
    session = toy.session()
    return Run(session.workflow, session.graph, Store(session.store_root), out=session.out, options=options).execute()


def test_until_runs_only_what_the_stage_needs(toy: Toy) -> None:
    assert ran(run(toy, RunOptions(until=("difference",)))) == {"images": 5, "scaled": 5, "pairs": 1, "difference": 4}
    assert ran(toy.run()).keys() == {"shifted", "views", "mean", "each", "all"}


def test_only_runs_one_unit_and_what_it_needs(toy: Toy) -> None:
    assert ran(run(toy, RunOptions(only=("mean:2.txt",)))) == {"images": 5, "scaled": 5, "views": 1, "mean": 1}
    assert ran(run(toy, RunOptions(only=("mean:2.txt", "mean:3.txt")))) == {"mean": 1}


def test_only_of_a_stage_beside_one_of_its_units_runs_the_stage(toy: Toy) -> None:
    assert ran(run(toy, RunOptions(only=("scaled", "scaled:2.txt")))) == {"images": 5, "scaled": 5}


def test_part_of_a_run_deletes_no_file_of_the_whole(toy: Toy) -> None:
    earlier = toy.run().published
    files = toy.deliverables()
    session = toy.session()
    options = RunOptions(until=("scaled",))
    result = Run(session.workflow, session.graph, Store(session.store_root), out=session.out, options=options).execute(
        earlier_files=earlier
    )
    assert not result.removed
    assert toy.deliverables() == files


def test_refresh_computes_again_and_what_turns_out_the_same_ends_there(finished: Toy) -> None:
    assert ran(run(finished, RunOptions(refresh=("scaled",)))) == {"scaled": 5}
    assert ran(run(finished, RunOptions(refresh=("mean:1.txt",)))) == {"mean": 1}
    assert ran(finished.run()) == {}


def test_refresh_of_a_unit_that_there_is_not_says_so(toy: Toy) -> None:
    assert any("--refresh mean:7.txt" in warning for warning in run(toy, RunOptions(refresh=("mean:7.txt",))).warnings)
    assert not run(toy, RunOptions(refresh=("mean:1.txt",))).warnings


@pytest.mark.slow
def test_accepted_code_keeps_what_was_computed(finished: Toy) -> None:
    finished.edit(
        "plug.py", lambda text: text.replace("double(x.value) * params.by / 2", "double(x.value) / 2 * params.by")
    )
    assert ran(finished.run("scaled.by=4"))["scaled"] == 5
    finished.edit("plug.py", lambda text: text.replace("x.value == 13", "13 == x.value"))
    finished.run()
    finished.edit("plug.py", lambda text: text.replace("13 == x.value", "x.value in (13,)"))
    options = RunOptions(accept_code=True)
    session = finished.session()
    plans = make_plan(session.workflow, session.graph, Store(session.store_root), options=options)
    assert sum(len(plan.run) + len(plan.may_run) for plan in plans) == 0
    assert finished.plan()["images"].run, "a plan that accepts keeps nothing"
    assert ran(run(finished, options)) == {}
    assert ran(finished.run()) == {}, "what was accepted once is cached"


def test_code_that_changed_with_a_setting_is_not_accepted(finished: Toy) -> None:
    finished.edit("plug.py", lambda text: text.replace("x.value == 13", "13 == x.value"))
    finished.edit("wf.yaml", lambda text: text.replace("by: 3", "by: 5"))
    assert ran(run(finished, RunOptions(accept_code=True)))["scaled"] == 5


def test_an_upgraded_library_costs_what_uses_it_and_can_be_accepted(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_code, "library_versions", lambda names: {"numba": "0.61.2"})
    toy.run()
    monkeypatch.setattr(stage_code, "library_versions", lambda names: {"numba": "0.62.0"})
    assert set(toy.plan()["images"].run.values()) == {"numba 0.61.2 → 0.62.0"}
    assert ran(run(toy, RunOptions(accept_code=True))) == {}
    toy.edit("plug.py", lambda text: text.replace("x.value == 13", "13 == x.value"))
    monkeypatch.setattr(stage_code, "library_versions", lambda names: {"numpy": "2.0.0"})
    assert "code of toy.source changed" in toy.plan()["images"].run["1.txt"]
    assert ran(run(toy, RunOptions(accept_code=True))) == {}, "changed code may use other libraries"


def test_random_numbers_are_those_of_before_when_only_the_code_has_changed(
    toy: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []

    def noted(rng: np.random.Generator, *others: Any) -> Context:
        seeds.append(int(rng.integers(2**60)))
        return Context(rng, *others)

    monkeypatch.setattr(execute, "Context", noted)
    toy.run()
    before = sorted(seeds)
    seeds.clear()
    toy.edit("plug.py", lambda text: text.replace("x.value == 13", "13 == x.value"))
    toy.run()
    assert before
    assert set(seeds) <= set(before)
    assert len(set(before)) == len(before), "each unit draws its own"


def test_keep_going_goes_on_where_the_workflow_would_stop(toy: Toy) -> None:
    toy.number("3.txt", "13")
    toy.edit("wf.yaml", lambda text: text.replace("by: 3}", "by: 3, on_error: stop}"))
    assert run(toy, RunOptions()).exit_code == 4
    assert run(toy, RunOptions(keep_going=True)).exit_code == 3


@pytest.mark.parametrize("options", [RunOptions(until=("nowhere",)), RunOptions(refresh=("nowhere:a",))])
def test_stage_that_is_not_there_is_named(toy: Toy, options: RunOptions) -> None:
    with pytest.raises(UsageError, match="no stage 'nowhere'"):
        run(toy, options)


def test_unit_that_is_not_there_is_named(toy: Toy) -> None:
    with pytest.raises(UsageError, match=r"mean has no unit '9\.txt'"):
        run(toy, RunOptions(only=("mean:9.txt",)))


def test_plan_says_what_was_asked_for(finished: Toy) -> None:
    session = finished.session()
    options = RunOptions(until=("mean",), refresh=("scaled:1.txt",))
    workflow, graph = options.applied_to(session.workflow, session.graph)
    plans = make_plan(workflow, graph, Store(session.store_root), options=options)
    assert {plan.name: plan.run for plan in plans if plan.run} == {"scaled": {"1.txt": "--refresh"}}
    assert plans[-1].name == "mean"


def test_another_seed_draws_other_numbers_and_computes_only_what_follows(toy: Toy) -> None:
    toy.run()
    text = toy.deliverables()["all.txt"]
    plan = toy.plan("all.rng_seed=1")
    assert {name: set(stage.run.values()) for name, stage in plan.items() if stage.run} == {"all": {"rng_seed 0 → 1"}}
    assert ran(toy.run("all.rng_seed=1")) == {"all": 1}
    other = toy.deliverables()["all.txt"]
    assert other.rpartition(b" ")[0] == text.rpartition(b" ")[0]
    assert other != text
    assert ran(toy.run()) == {}
    assert toy.deliverables()["all.txt"] == text
    assert ran(toy.run("all.rng_seed=1")) == {}
    assert toy.deliverables()["all.txt"] == other


def test_without_a_seed_no_key_changes(toy: Toy) -> None:
    toy.run()
    assert not any(stage.run for stage in toy.plan("all.rng_seed=0", "scaled.rng_seed=null").values())
    assert len(toy.plan("scaled.rng_seed=2")["scaled"].run) == 5
