from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pano_mvs.core.errors import InputError, RunStoppedError, StoreError, UsageError, WorkflowError
from pano_mvs.core.files import remove_whole
from pano_mvs.engine.cache.latest_runs import RunHistory
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running.events import RunEvent, StageFinished
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.stages.registry import Registry
from tests.engine.conftest import Toy, ran
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
    assert second.cached == sum(ALL_UNITS.values())
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
    blocked = {(f.stage, f.item) for f in result.failures[1:]}
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


def test_a_note_says_how_many_units_gave_it(toy: Toy) -> None:
    """Notes of several units spoke of "some images"."""
    noted = """ctx.note("{count} are dark") if x.value > 25 else ctx.note("a {count} in braces")
    ctx.metric("value", x.value)"""
    toy.edit("plug.py", lambda text: text.replace('ctx.metric("value", x.value)', noted))
    for _ in range(2):
        notes = {stage.name: stage.notes for stage in toy.run().stages}
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
    toy.edit("plug.py", lambda text: "from pano_mvs.stages.depth import nearest\n" + text)
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
