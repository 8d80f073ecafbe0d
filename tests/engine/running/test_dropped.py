"""Results of temporary stages: dropped when nothing reads them any more, and computed again when something does."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.engine.cache import dropping
from pano_mvs.engine.cache.dropping import dropping_after
from pano_mvs.engine.cache.maintenance import collect, pack, usage_of, verify
from pano_mvs.engine.cache.packs import Packed
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import ExecutorRequest, SerialExecutor, make_executor
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.planning.plan import RunOptions
from pano_mvs.engine.planning.temporary import temporary_stages
from pano_mvs.engine.running import dropped
from pano_mvs.engine.running.run import Run
from pano_mvs.scene import Record
from tests.engine.conftest import ran, settle
from tests.engine.rows import KEPT, TEMPORARY, WORKFLOW, Rows


@dataclass(frozen=True, eq=False)
class Numbers(Record):
    """A kind of the same name as that of the plugin."""

    values: NDArray[np.float64]


def fresh_files(rows: Rows, *overrides: str) -> dict[str, str]:
    """Return the files of the same run with an empty cache."""
    (rows.folder / "fresh").mkdir()
    fresh = Rows(rows.folder / "fresh")
    fresh.run(*overrides)
    return fresh.files()


@pytest.fixture
def rows(tmp_path: Path) -> Rows:
    return Rows(tmp_path)


def test_results_of_temporary_stages_are_dropped_and_the_second_run_computes_nothing(rows: Rows) -> None:
    first = rows.run()
    assert first.exit_code == 0
    assert rows.kept() == KEPT
    assert all(record.dropped for stage in TEMPORARY for record in rows.records(stage))
    second = rows.run()
    assert (second.computed, second.units["cached"], second.warnings) == (0, first.computed, [])
    assert second.published == first.published


def test_plan_counts_dropped_units_as_cached_and_says_so(rows: Rows) -> None:
    rows.run()
    plan = rows.plan()
    assert all(not stage.run and not stage.may_run for stage in plan.values())
    assert {name: len(stage.dropped) for name, stage in plan.items() if stage.dropped} == dict.fromkeys(TEMPORARY, 4)


def test_a_changed_setting_computes_exactly_what_it_needs_again(rows: Rows) -> None:
    rows.run()
    plan = rows.plan("last.value=6")
    assert {name: sorted(set(stage.run.values())) for name, stage in plan.items() if stage.run} == {
        "first": ["dropped after an earlier run; mean reads it"],
        "second": ["dropped after an earlier run; mean reads it"],
        "mean": ["dropped after an earlier run; last reads it"],
        "last": ["param value 5.0 → 6.0"],
    }
    assert list(plan["first"].run) == ["0.txt", "1.txt", "2.txt", "3.txt"]
    result = rows.run("last.value=6")
    assert ran(result) == {"first": 4, "second": 4, "mean": 4, "last": 4, "files": 4}
    assert result.warnings == []
    assert rows.kept() == KEPT, "what was computed again is dropped again"
    assert rows.files() == fresh_files(rows, "last.value=6")


def test_one_changed_unit_computes_only_what_it_reads_again(rows: Rows) -> None:
    rows.run()
    path = rows.folder / "capture" / "0.txt"
    path.write_text("77")
    settle(path)
    plan = rows.plan()
    assert list(plan["images"].run) == ["0.txt"]
    assert all(not stage.run for name, stage in plan.items() if name != "images")
    assert plan["first"].may_run == ["0.txt", "1.txt", "2.txt"]
    assert plan["second"].may_run == ["0.txt", "1.txt"]
    assert plan["first"].cached == plan["first"].dropped == ["3.txt"]
    result = rows.run()
    # 0 is new; mean of 0 and 1 read first of 0, 1 and 2, and second of 0 and 1.
    assert ran(result) == {"images": 1, "first": 3, "second": 2, "mean": 2, "last": 2, "files": 2}


def test_a_unit_of_a_collection_is_computed_again_with_the_whole(tmp_path: Path) -> None:
    text = WORKFLOW.replace(
        "  views:", "  row:    {use: rows.all, in: {xs: second}, temporary: true}\n  views:"
    ).replace("own: second, around: first", "own: row, around: row")
    text += "  rows:   {use: rows.all, in: {xs: last}}\n"
    rows = Rows(tmp_path, text)
    assert rows.run().exit_code == 0
    assert not rows.has("row")
    result = rows.run("mean.factor=2")
    assert ran(result) == {"first": 4, "second": 4, "row": 1, "mean": 4, "last": 4, "files": 4, "rows": 1}
    assert not rows.has("row")


def test_keep_all_keeps_everything_and_computes_again_what_is_missing(rows: Rows) -> None:
    keep = RunOptions(keep_all=True)
    rows.run()
    reasons = {reason for stage in rows.plan(options=keep).values() for reason in stage.run.values()}
    assert reasons == {"dropped after an earlier run, and to be kept now"}
    assert ran(rows.run(options=keep)) == dict.fromkeys(TEMPORARY, 4)
    assert rows.kept() == {*KEPT, *TEMPORARY}
    assert rows.run(options=keep).computed == 0
    assert rows.run().computed == 0
    assert rows.kept() == KEPT, "without the option, they are dropped"


def test_a_setting_of_the_command_line_makes_a_stage_lasting(rows: Rows) -> None:
    rows.run("second.temporary=false")
    assert rows.kept() == {*KEPT, "second"}
    assert ran(rows.run("mean.factor=2", "second.temporary=false")) == {"first": 4, "mean": 4, "last": 4, "files": 4}


@pytest.mark.parametrize("stage", ["images", "views", "last", "files"])
def test_what_is_needed_later_is_never_temporary(rows: Rows, stage: str) -> None:
    session = rows.session(f"{stage}.temporary=true")
    assert tuple(temporary_stages(session.workflow, session.graph)) == TEMPORARY


def test_keys_do_not_depend_on_what_is_temporary(rows: Rows) -> None:
    rows.run()
    before = next(rows.store.runs.each()).keys
    rows.run(*(f"{stage}.temporary=false" for stage in TEMPORARY))
    assert next(rows.store.runs.each()).keys == before


def test_a_blob_that_a_lasting_result_shares_stays(rows: Rows) -> None:
    """With 0 added, the last stage has the same array as the one before it."""
    rows.run("last.value=0")
    assert rows.has("mean")
    assert all(record.dropped for record in rows.records("mean"))
    found = verify(rows.store)
    assert (found.removed, found.incomplete) == ([], [])
    assert rows.run("last.value=0").computed == 0
    changed = rows.run("last.value=4")
    assert ran(changed) == {"last": 4, "files": 4}, "what is still there is not computed again"


def test_dropped_results_are_intact_to_verify_and_no_garbage(rows: Rows) -> None:
    rows.run()
    found = verify(rows.store)
    assert (found.removed, found.incomplete, found.foreign, found.temporary) == ([], [], [], [])
    assert found.records == 4 * 6 + 1
    garbage = collect(rows.store, unused_s=0, delete=True)
    assert (garbage.records, garbage.blobs, garbage.size_bytes) == ([], [], 0)
    sizes = {usage.stage: usage.size_bytes for usage in usage_of(rows.store)}
    assert sizes["rows.mean"] < sizes["rows.write"]
    assert rows.run().computed == 0


def test_what_a_killed_process_left_of_dropped_results_is_garbage(rows: Rows, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dropping, "_delete", lambda *_: 0)
    rows.run()
    assert rows.has("mean")
    assert collect(rows.store, unused_s=0, delete=True).blobs
    assert not rows.has("mean")
    assert rows.run().computed == 0


def test_results_in_packs_are_dropped_too(rows: Rows, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pano_mvs.engine.cache.maintenance._MIN_PACKED_FILES", 1)
    rows.run(options=RunOptions(keep_all=True))
    assert list((rows.folder / "cache" / "packs").glob("*.pack"))
    assert rows.kept() == {*KEPT, *TEMPORARY}
    before = sum(path.stat().st_size for path in (rows.folder / "cache" / "packs").iterdir())
    rows.run()
    assert rows.kept() == KEPT
    assert sum(path.stat().st_size for path in (rows.folder / "cache" / "packs").iterdir()) < before - 10 * 800
    pack(rows.store)
    assert rows.run().computed == 0
    assert rows.run("last.value=8").warnings == []


def test_a_pinned_run_keeps_its_results(rows: Rows) -> None:
    rows.run(options=RunOptions(keep_all=True))
    rows.store.runs.pin(str(rows.folder / "out"), "mine")
    rows.run()
    assert rows.kept() == {*KEPT, *TEMPORARY}


def test_results_that_another_run_keeps_stay(rows: Rows) -> None:
    rows.run("mean.temporary=false", out="other")
    rows.run()
    assert rows.kept() == {*KEPT, "mean"}
    rows.run(out="other")
    assert rows.kept() == KEPT, "now neither of them keeps it"


def test_part_of_a_run_drops_nothing(rows: Rows) -> None:
    assert ran(rows.run(options=RunOptions(until=("mean",)))) == {
        "images": 4, "first": 4, "second": 4, "views": 1, "mean": 4
    }  # fmt: skip
    assert all(rows.has(stage) for stage in TEMPORARY)
    assert ran(rows.run()) == {"last": 4, "files": 4}
    assert rows.kept() == KEPT


def test_a_stage_that_is_asked_for_is_computed_again(rows: Rows) -> None:
    rows.run()
    assert ran(rows.run(options=RunOptions(only=("second:1.txt",)))) == {"first": 1, "second": 1}
    assert rows.run(options=RunOptions(until=("last",))).computed == 0


def test_stages_that_are_asked_for_are_computed_again_although_others_replace_them(rows: Rows) -> None:
    rows.run()
    assert ran(rows.run(options=RunOptions(until=("second", "last")))) == {"first": 4, "second": 4}
    assert rows.has("second")


def test_what_a_failed_unit_reads_stays(rows: Rows) -> None:
    result = rows.run("mean.fails_at=16")
    assert result.exit_code == 3
    assert rows.has("first")
    assert rows.has("second")
    assert not rows.has("mean"), "all that could read it have"
    assert ran(rows.run("mean.fails_at=16")) == {}


def test_a_refreshed_unit_has_its_inputs_again(rows: Rows) -> None:
    rows.run()
    result = rows.run(options=RunOptions(refresh=("mean",)))
    assert ran(result) == {"first": 4, "second": 4, "mean": 4}
    assert rows.kept() == KEPT


class Answering(SerialExecutor):
    """Fails the units that it is told to, and notes what it computes."""

    def __init__(self, store: Store, failing: Callable[[str], bool] = lambda _: False) -> None:
        super().__init__(store, threads=1)
        self.failing = failing
        self.seen: list[str] = []

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        if timeout_s != 0 and self._jobs:
            self.seen.append(self._jobs[0].unit.label)
            if self.failing(self.seen[-1]):
                return self._jobs.pop(0).number, JobOutcome("failed", cause="as asked")
        return super().wait(timeout_s)


def test_a_result_that_cannot_be_computed_again_fails_what_reads_it(rows: Rows) -> None:
    rows.run()
    session, store = rows.session("last.value=6"), rows.store
    executor = Answering(store, lambda label: label == "first:1.txt")
    result = Run(session.workflow, session.graph, store, out=session.out, executor=executor).execute()
    assert result.exit_code == 3
    assert [(failure.stage, failure.item) for failure in result.failures] == [("first", "1.txt")]
    assert {f"{unit.stage}:{unit.item}": unit.cause for unit in result.blocked} == {
        **{f"last:{idx}.txt": "it needs first:1.txt, which failed" for idx in range(3)},
        **{f"files:{idx}.txt": f"it needs last:{idx}.txt, which failed" for idx in range(3)},
    }
    counts = {one.stage: (one.run, one.cached, one.failed) for one in result.stages}
    assert counts["first"] == (3, 0, 1)
    assert executor.seen.count("first:1.txt") == 1
    again = rows.run("last.value=6")
    assert again.exit_code == 0
    assert rows.kept() == KEPT


def test_another_result_than_before_computes_what_reads_it(rows: Rows) -> None:
    """As on another machine: the digests of what was dropped are not those of what is computed now."""
    rows.run()
    store = rows.store
    for idx, record in enumerate(rows.records("first")):
        other = store.put_value(Numbers(np.arange(100.0) + 1000 + idx))
        store.replace([replace(record, output=other)])
        for ref in other.blobs():
            store.blobs.path(ref).unlink()
    for stage in ("second", "mean"):  # their keys followed from the other digests
        for record in rows.records(stage):
            store.drop(record.key)
    result = rows.run("last.value=6")
    assert result.exit_code == 0
    assert result.warnings
    assert all("has another result than the one that was dropped" in text for text in result.warnings)
    assert rows.files() == fresh_files(rows, "last.value=6")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["serial", "processes"])
def test_every_executor_drops_and_computes_again(rows: Rows, name: str) -> None:
    store = rows.store
    for overrides, expected in (((), 25), (("last.value=6",), 20), (("last.value=6",), 0)):
        session = rows.session(*overrides)
        executor = make_executor(store, ExecutorRequest(name, workers=1 if name == "serial" else 2, threads=1))
        try:
            result = Run(session.workflow, session.graph, store, out=session.out, executor=executor).execute()
        finally:
            executor.close()
        assert (result.exit_code, result.computed, result.warnings) == (0, expected, [])
        assert rows.kept() == KEPT


def test_results_are_dropped_during_a_run_if_they_take_much_space(rows: Rows, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dropped, "MUCH_BYTES", 2000)
    had: dict[str, int] = {}

    class Watching(Answering):
        def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
            if timeout_s != 0 and self._jobs and self._jobs[0].unit.label == "files:0.txt":
                stored = [path.stat().st_size for path in (rows.folder / "cache" / "blobs").rglob("*.npy")]
                had["arrays"] = len(stored)
            return super().wait(timeout_s)

    session, store = rows.session(), rows.store
    result = Run(session.workflow, session.graph, store, out=session.out, executor=Watching(store)).execute()
    assert (result.exit_code, result.warnings) == (0, [])
    assert had["arrays"] == 8, "those of images and last"
    assert rows.kept() == KEPT


def test_nothing_is_dropped_while_another_run_uses_the_cache(rows: Rows) -> None:
    with rows.store.in_use() as is_alone:
        assert is_alone()
        rows.run()
        assert rows.kept() == {*KEPT, *TEMPORARY}
    rows.run(out="second")
    assert rows.kept() == KEPT, "the run that ends last drops what neither needs"


def test_the_mark_of_a_process_that_was_killed_hinders_nobody(rows: Rows) -> None:
    rows.run(options=RunOptions(keep_all=True))
    with rows.store.in_use():
        marks = list((rows.folder / "cache" / "tmp").glob("*-run-*"))
    assert len(marks) == 1
    dead = marks[0].name.replace(f"-{os.getpid()}-", "-4194999-")
    (rows.folder / "cache" / "tmp" / dead).touch()
    rows.run()
    assert rows.kept() == KEPT


def test_what_another_run_drops_meanwhile_is_computed_again_without_damage(rows: Rows) -> None:
    rows.run(options=RunOptions(keep_all=True))
    session, store = rows.session("last.value=6"), rows.store

    class Racing(Answering):
        def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
            if not self.seen and self._jobs:
                keys = {record.key for stage in TEMPORARY for record in rows.records(stage)}
                assert dropping._drop(rows.store, keys) > 0
            return super().wait(timeout_s)

    result = Run(session.workflow, session.graph, store, out=session.out, executor=Racing(store)).execute()
    assert result.exit_code == 0
    assert result.warnings
    assert all("another run has dropped what last:" in text for text in result.warnings)
    assert rows.kept() == KEPT


def test_runs_that_share_units_drop_them_when_all_have_ended(rows: Rows) -> None:
    with dropping_after([rows.folder / "cache"]):
        rows.run("last.value=1", out="one")
        second = rows.run("last.value=2", out="two")
    assert ran(second) == {"last": 4, "files": 4}
    assert rows.kept(of="one") == rows.kept(of="two") == KEPT


def test_an_interrupted_run_drops_nothing_and_goes_on(rows: Rows) -> None:
    session, store = rows.session(), rows.store

    class Interrupted(Answering):
        def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
            if timeout_s != 0 and self._jobs and self._jobs[0].unit.label == "last:2.txt":
                raise KeyboardInterrupt
            return super().wait(timeout_s)

    with pytest.raises(KeyboardInterrupt):
        Run(session.workflow, session.graph, store, out=session.out, executor=Interrupted(store)).execute()
    assert all(rows.has(stage) for stage in TEMPORARY)
    assert ran(rows.run()) == {"last": 2, "files": 4}
    assert rows.kept() == KEPT


def test_a_deliverable_that_was_deleted_is_written_again_from_the_cache(rows: Rows) -> None:
    rows.run()
    before = rows.files()
    (rows.folder / "out" / "1.txt").unlink()
    assert rows.run().computed == 0
    assert rows.files() == before


def test_accepted_code_accepts_what_was_dropped(rows: Rows) -> None:
    rows.run()
    path = rows.folder / "rows.py"
    path.write_text(path.read_text().replace('"""Add."""', '"""Add."""\n    assert params is not None'))
    result = rows.run(options=RunOptions(accept_code=True))
    assert (result.computed, result.warnings) == (0, [])
    assert rows.run().computed == 0


def test_a_cache_of_before_is_read_and_its_results_are_dropped(rows: Rows) -> None:
    """Records and lists of runs of earlier versions say nothing of temporary results."""
    rows.run(options=RunOptions(keep_all=True))
    entry = json.loads(next((rows.folder / "cache" / "runs").iterdir()).read_bytes().partition(b"\n")[2])
    assert "temporary" not in entry
    assert all("dropped" not in record.to_json() for record in rows.records("mean"))
    assert rows.run().computed == 0
    assert rows.kept() == KEPT


def test_a_second_run_reads_no_other_record(rows: Rows, monkeypatch: pytest.MonkeyPatch) -> None:
    rows.run()
    monkeypatch.setattr(dropping, "each_record", lambda _: pytest.fail("all records were read"))
    assert rows.run().computed == 0


def test_the_mark_of_a_run_that_was_killed_elsewhere_is_named(rows: Rows) -> None:
    rows.run("last.value=5")
    mark = rows.store.root / "tmp" / ".tmp-deadbeef-4711-run-0123456789abcdef"
    mark.touch()
    os.utime(mark, (0, time.time() - 2 * 24 * 3600))
    result = rows.run("first.value=7")
    assert rows.has("first")
    assert any(f"delete {mark}" in warning for warning in result.warnings), result.warnings
    mark.unlink()
    assert rows.run("first.value=700").warnings == []
    assert rows.kept() == KEPT


def test_a_setting_named_dropped_drops_nothing(rows: Rows) -> None:
    rows.run()
    record = rows.records("last")[0]
    named = replace(record, identity={**record.identity, "params": {"dropped": True}})
    rows.store.replace([named])
    shared = {ref.digest for ref in named.blobs()}
    assert shared <= dropping._digests_in_use(rows.store, ())


def test_values_that_are_packed_twice_are_dropped_in_both_packs(rows: Rows, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pano_mvs.engine.cache.maintenance._MIN_PACKED_FILES", 1)
    rows.run(options=RunOptions(keep_all=True))
    store = rows.store
    record = rows.records("first")[0]
    pack(store)
    for value in record.own_blobs():
        place = store.blobs.place(value)
        assert isinstance(place, Packed)
        store.blobs.packs.add([(place, None)])
    packed = store.packed_record(record.key)
    assert packed is not None
    store.blobs.packs.add([(packed, None)])
    assert dropping._drop(store, {record.key})
    assert not any(store.blobs.exists(ref) for ref in record.blobs() if ref.suffix != ".json")
    again = store.read_record(record.key)
    assert again is not None
    assert again.dropped
