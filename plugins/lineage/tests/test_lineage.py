"""Runs are listed by what differs, compared with reasons, and files lead back to their units."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pano_mvs_lineage.diff import Change, PoseChanges, RunDiff, _images, _reason, diff
from pano_mvs_lineage.page import diff_page
from pano_mvs_lineage.range_changes import compare_ranges
from pano_mvs_lineage.runs import runs
from pano_mvs_lineage.stored_runs import StoredRun
from pano_mvs_lineage.why import repeat, why

import pano_mvs as package
from pano_mvs.core.digest import digest_from_bytes, digest_from_file
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.stages.params import Params
from pano_mvs.engine.stages.stage import StageSpec
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.results.origin import Origin, RunName
from pano_mvs.session.code_listing import read_code_listing, write_code_listing
from pano_mvs.session.running import Execution, run_session
from pano_mvs.session.session import RunOptions
from tests.cli.conftest import Command
from tests.engine.conftest import Toy, toy_in


def run_into(toy: Toy, out: str, *overrides: str) -> Path:
    """Run the toy workflow into a folder beside the others, with their cache, and return the folder."""
    session = replace(toy.session(*overrides), out=toy.folder / "runs" / out)
    run_session(session, Execution("serial"))
    return session.out


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Toy, Path, Path]:
    """Two runs of the toy workflow that differ in one setting; beside their folder is a copy of it."""
    folder = tmp_path_factory.mktemp("made") / "toy"
    folder.mkdir()
    toy = toy_in(folder)
    found = toy, run_into(toy, "first"), run_into(toy, "second", "scaled.by=4")
    shutil.copytree(folder, folder.with_name("kept"))
    return found


@pytest.fixture
def two(made: tuple[Toy, Path, Path]) -> tuple[Toy, Path, Path]:
    """The two runs as they were made, in the same folder for each test, since they hold absolute paths."""
    folder = made[0].folder
    shutil.rmtree(folder)
    shutil.copytree(folder.with_name("kept"), folder)
    return made


def test_runs_are_listed_with_the_settings_in_which_they_differ(two: tuple[Toy, Path, Path]) -> None:
    toy, first, second = two
    table = runs([toy.folder / "runs"], metrics=["scaled.value"])
    assert [row.out for row in table.rows] == [first, second]
    assert table.settings == ("scaled.by",)
    assert [row.settings["scaled.by"] for row in table.rows] == [3.0, 4.0]
    assert [row.metrics["scaled.value"] for row in table.rows] == [table.rows[0].metrics["scaled.value"]] * 2
    backwards = runs([toy.folder / "runs"], sort="-scaled.by")
    assert [row.out for row in backwards.rows] == [second, first]
    assert table.to_csv().splitlines()[0] == "out,workflow,started,exit,s,registered,images,scaled.by,scaled.value"
    assert len(json.dumps(table.to_json())) > 100


def test_runs_that_cannot_be_read_are_named_and_left_out(two: tuple[Toy, Path, Path]) -> None:
    toy, first, second = two
    (second / "run.json").write_text('{"schema": 99, "stages": []}')
    table = runs([toy.folder / "runs"])
    assert [row.out for row in table.rows] == [first]
    (reason,) = table.skipped
    assert "newer version" in reason
    (first / "run.json").write_text("[]")
    with pytest.raises(InputError, match="no run can be read"):
        runs([toy.folder / "runs"])


def test_a_run_that_lacks_a_stage_hides_no_setting(two: tuple[Toy, Path, Path]) -> None:
    toy, _, _ = two
    session = replace(toy.session(), out=toy.folder / "runs" / "part", run_options=RunOptions(until=("images",)))
    run_session(session, Execution("serial"))
    table = runs(toy.folder / "runs")  # one folder is no sequence of letters
    assert len(table.rows) == 3
    assert table.settings == ("scaled.by",)


def test_runs_without_a_value_come_last_in_either_order(two: tuple[Toy, Path, Path]) -> None:
    """With the largest first, runs that lack the setting were listed before all others."""
    toy, first, second = two
    session = replace(toy.session(), out=toy.folder / "runs" / "part", run_options=RunOptions(until=("images",)))
    run_session(session, Execution("serial"))
    for sort, order in (("scaled.by", [first, second]), ("-scaled.by", [second, first])):
        assert [row.out for row in runs(toy.folder / "runs", sort=sort).rows] == [*order, session.out]


def test_links_to_runs_are_followed_and_no_run_is_listed_twice(two: tuple[Toy, Path, Path], tmp_path: Path) -> None:
    toy, first, second = two
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "one").symlink_to(first)
    (first / "back").symlink_to(toy.folder / "runs")  # which would never end
    assert [row.out for row in runs([tmp_path / "linked"]).rows] == [
        tmp_path / "linked" / "one",
        tmp_path / "linked" / "one" / "back" / "second",
    ]
    assert len(runs([toy.folder / "runs", second, tmp_path / "linked"]).rows) == 2


def test_mistakes_in_lists_of_runs_name_what_there_is(two: tuple[Toy, Path, Path], tmp_path: Path) -> None:
    toy, _, _ = two
    with pytest.raises(UsageError, match=r"no run has the metric 'depth\.nothing'; there are: .*scaled\.value"):
        runs([toy.folder / "runs"], metrics=["depth.nothing"])
    with pytest.raises(UsageError, match="no such column; there are out, workflow"):
        runs([toy.folder / "runs"], sort="nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no run in this folder or below it; each has a run\.json"):
        runs([tmp_path / "empty"])
    with pytest.raises(InputError, match="no such folder"):
        runs([tmp_path / "nowhere"])


def test_a_setting_that_differs_is_the_reason_for_the_units_behind_it(two: tuple[Toy, Path, Path]) -> None:
    _, first, second = two
    found = diff(first, second)
    assert [str(change) for change in found.settings] == ["scaled.by: 3 → 4"]
    assert not found.stages
    assert not found.versions
    assert found.reasons["scaled"] == "setting by: 3 → 4"
    assert "images" not in found.reasons
    assert found.reasons["difference"] == "inputs of scaled"
    assert found.files
    assert not found.is_same
    assert json.loads(json.dumps(found.to_json()))["same"] is False
    assert "why units differ:" in found.lines()


def test_images_and_code_that_differ_are_reasons(toy: Toy) -> None:
    first = run_into(toy, "first")
    toy.number("1.txt", "8")
    toy.edit("plug.py", lambda text: text.replace("double(x.value) * params.by / 2", "double(x.value) / 2 * params.by"))
    second = run_into(toy, "second")
    found = diff(first, second)
    assert [change.name for change in found.images] == ["1.txt"]
    assert "code of toy.scale (plug.py: scale)" in found.reasons["scaled"]
    assert any("other content: 1.txt" in line for line in found.lines())


def test_images_that_were_added_are_counted_alone(toy: Toy) -> None:
    """It said that 0 of 5 units differ."""
    first = run_into(toy, "first")
    toy.number("6.txt", "8")
    assert diff(first, run_into(toy, "second")).reasons["images"] == "1 unit more"


def test_the_functions_that_differ_are_named(toy: Toy) -> None:
    """Only the stage was named, whose code are all modules that it imports."""
    first = run_into(toy, "first")
    toy.edit("helper.py", lambda text: text.replace("return 2 * x", "return x * 2") + "\nLIMIT = 3\n")
    second = run_into(toy, "second")
    assert diff(first, second).reasons["scaled"] == "code of toy.scale (helper.py: outside of functions, double)"
    toy.edit("helper.py", lambda text: f"# a comment\n{text}")
    assert diff(second, run_into(toy, "third")).is_same
    (second / "logs" / "code.json").write_text("[]")
    assert diff(first, second).reasons["scaled"] == "code of toy.scale"


def test_files_that_settings_name_differ_by_their_content() -> None:
    """It listed digests: setting path: ['4bac70…'] → ['00c85f…']."""
    before, after = (
        {"stage": "poses", "params": {"path": [digest_from_bytes(text)], "by": 2}} for text in (b"a", b"b")
    )
    assert _reason(before, after, producers={}, functions=()) == "content of the setting path"
    numbers = ({"params": {"limits": limits}} for limits in ([1], [2]))
    assert _reason(*numbers, producers={}, functions=()) == "setting limits: [1] → [2]"


def test_functions_of_one_name_are_not_confused(toy: Toy) -> None:
    """Of a getter and its setter only the last one counted."""
    getter = "    @property\n    def value(self): return 1\n"
    added = f"\nclass Limit:\n{getter}    @value.setter\n    def value(self, to): pass\n"
    toy.edit("helper.py", lambda text: text + added)
    first = run_into(toy, "first")
    toy.edit("helper.py", lambda text: text.replace("return 1", "return 2"))
    assert "helper.py: Limit.value" in diff(first, run_into(toy, "second")).reasons["scaled"]


def test_files_of_one_name_in_two_folders_are_two(toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each stage was listed with the functions of the last file of this name."""

    def functions_of(spec: StageSpec, _: Params) -> dict[str, dict[str, str]]:
        return {"plug.py": {"run": spec.name}, "shared.py": {"": "1"}}

    monkeypatch.setattr("pano_mvs.session.code_listing.code_functions", functions_of)
    workflow = toy.session().workflow
    write_code_listing(tmp_path, workflow)
    for name in ("scaled", "mean"):
        entry = workflow.stages[name]
        digest = stage_code(entry.spec, entry.params).digest
        listed = read_code_listing(tmp_path, name, digest)
        assert listed == {"plug.py": {"run": entry.spec.name}, "shared.py": {"": "1"}}


def test_a_plugin_that_becomes_unreadable_during_a_run_costs_the_reasons_alone(toy: Toy, tmp_path: Path) -> None:
    """Bytes that are no text ended the run with an internal error, after its results were written."""
    workflow = toy.session().workflow
    (toy.folder / "helper.py").write_bytes(b"\xff\xfe\x00 = 1")
    write_code_listing(tmp_path, workflow)
    assert not (tmp_path / "logs" / "code.json").exists()


def test_reasons_are_in_the_order_of_the_workflow(two: tuple[Toy, Path, Path]) -> None:
    _, first, second = two
    stages = [stage.name for stage in package.load(second).summary.stages]
    reasons = list(diff(first, second).reasons)
    assert len(reasons) > 2
    assert reasons == [name for name in stages if name in reasons] != sorted(reasons)


def test_images_of_the_same_name_in_two_folders_are_two(two: tuple[Toy, Path, Path]) -> None:
    runs_ = [StoredRun.open(out) for out in two[1:]]
    inputs = ({"/a/c/hall/1.png": "x", "/a/c/attic/1.png": "y"}, {"/b/hall/1.png": "x", "/b/attic/1.png": "z"})
    old, new = (
        replace(run, summary=run.summary.model_copy(update={"inputs": own}))
        for run, own in zip(runs_, inputs, strict=True)
    )
    assert _images(old, new) == (Change("attic/1.png", "y", "z"),)


def test_a_repetition_that_fails_leaves_no_run_in_the_cache(
    two: tuple[Toy, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    toy, first, _ = two
    origin = why(first / next(iter(package.load(first).summary.files)))
    kept = {entry.out for entry in Store(toy.folder / "cache").runs.entries()}
    opened = StoredRun.open

    def fails(out: Path, cache: Path | None = None) -> StoredRun:
        if out not in two:
            raise InputError("gone")
        return opened(out, cache)

    monkeypatch.setattr(StoredRun, "open", fails)
    with pytest.raises(InputError, match="gone"):
        repeat(origin)
    assert {entry.out for entry in Store(toy.folder / "cache").runs.entries()} == kept


def test_equal_runs_are_the_same_and_one_run_is_not_two(toy: Toy) -> None:
    first, second = run_into(toy, "first"), run_into(toy, "second")
    found = diff(first, second)
    assert found.is_same
    assert found.lines() == ["the same settings, images, code and files"]
    gone = next(iter(package.load(second).summary.files))
    (second / gone).unlink()
    assert any(f"no longer in {second}: {gone}" in line for line in diff(first, second).lines())
    with pytest.raises(UsageError, match="are the same folder"):
        diff(first, first)
    with pytest.raises(InputError, match=r"run\.json cannot be read"):
        diff(first, toy.folder / "nowhere")


def test_runs_are_compared_without_their_cache_too(two: tuple[Toy, Path, Path]) -> None:
    toy, first, second = two
    shutil.rmtree(toy.folder / "cache")
    found = diff(first, second)
    assert [change.name for change in found.settings] == ["scaled.by"]
    assert not found.reasons
    assert any("is not there" in note for note in found.notes)
    assert any("is not there" in note for note in why(next(first.glob("*.txt"))).notes)


def as_earlier_version(out: Path) -> None:
    """Take from run.json what early versions did not write."""
    value = json.loads((out / "run.json").read_text())
    value["schema"] = 0
    for key in ("inputs", "versions", "started"):
        del value[key]
    for stage in value["stages"]:
        del stage["group"], stage["unit_seconds"]
    (out / "run.json").write_text(json.dumps(value))


def test_a_run_of_an_earlier_version_is_compared_by_what_it_lists(two: tuple[Toy, Path, Path]) -> None:
    """What it does not list was reported as a difference: no version and no image was the same."""
    toy, first, second = two
    as_earlier_version(second)
    found = diff(first, second)
    assert [str(change) for change in found.settings] == ["scaled.by: 3 → 4"]
    assert (found.images, found.versions) == ((), ())
    (note,) = [note for note in found.notes if "lists no images and no versions of libraries" in note]
    assert note.startswith(f"{second}: its run.json")
    assert found.lines()[:1] == ["notes:"]
    assert found.reasons["scaled"] == "setting by: 3 → 4"
    table = runs([toy.folder / "runs"])
    assert table.notes == (note,)
    assert [row.out for row in table.rows if not row.started] == [second]
    lines = why(second / next(iter(package.load(second).summary.files))).lines()
    assert "started at an unknown time" in lines[1]
    assert "images: run.json does not list them" in lines


@pytest.mark.parametrize("what", ["run.json", "files", "records", "runs", "blobs"])
def test_a_run_that_was_half_deleted_is_compared_as_far_as_possible(
    two: tuple[Toy, Path, Path], pano_mvs: Command, what: str
) -> None:
    toy, first, second = two
    name = next(iter(package.load(second).summary.files))
    if what == "run.json":
        (second / "run.json").write_bytes((second / "run.json").read_bytes()[:100])
        for words in (("diff", first, second), ("why", second / name)):
            done = pano_mvs(*words)
            assert (done.code, "is not a valid run.json" in done.flat) == (2, True)
        assert [row.out for row in runs([toy.folder / "runs"]).rows] == [first]
        return
    if what == "files":
        for each in package.load(second).summary.files:
            (second / each).unlink()
    else:
        shutil.rmtree(toy.folder / "cache" / what)
    found = diff(first, second)
    assert [str(change) for change in found.settings] == ["scaled.by: 3 → 4"]
    assert len(runs([toy.folder / "runs"]).rows) == 2
    if what == "files":
        assert any(f"no longer in {second}: " in note for note in found.notes)
        done = pano_mvs("why", second / name)
        assert (done.code, "there is no such file" in done.flat) == (2, True)
        return
    origin = why(second / name)
    assert origin.units or origin.notes, "there is a clear line"
    if what == "runs":
        assert any("contains no run into" in note for note in found.notes)


def test_runs_of_different_captures_are_named(two: tuple[Toy, Path, Path], pano_mvs: Command) -> None:
    """Images of the same names were compared as if they were of one capture."""
    toy, first, _ = two
    for path in list((toy.folder / "capture").iterdir()):
        toy.number(path.name, f"{float(path.read_text()) + 100}")
    third = run_into(toy, "third")
    found = diff(first, third)
    assert found.notes[0].startswith("the runs are probably of different captures: no image of theirs is the same")
    assert found.lines()[1] == f"  {found.notes[0]}"
    (note,) = runs([toy.folder / "runs"]).notes
    assert note.startswith("the runs are of 2 different captures, whose metrics do not compare: ")
    assert f"note: {note}" in pano_mvs("runs", toy.folder / "runs").flat
    for path in list((toy.folder / "capture").iterdir()):
        path.rename(path.with_name(f"other_{path.name}"))
    fourth = run_into(toy, "fourth")
    assert diff(first, fourth).notes[0].startswith("the runs are of different captures: they have no image in common")
    assert diff(first, two[2]).notes == runs([first, two[2]]).notes == ()


def test_a_text_is_one_metric(two: tuple[Toy, Path, Path]) -> None:
    toy, _, _ = two
    assert runs(toy.folder / "runs", metrics="scaled.value").metrics == ("scaled.value",)


def test_a_file_leads_back_to_its_unit_and_to_the_images(two: tuple[Toy, Path, Path], tmp_path: Path) -> None:
    toy, first, _ = two
    name = next(name for name in package.load(first).summary.files)
    origin = why(first / name)
    assert (origin.name, origin.out, origin.was_changed) == (name, first, False)
    assert origin.units[0].depth == 0
    assert {unit.stage for unit in origin.units} > {"images", "scaled"}
    assert {Path(path).name for path in origin.images} == {path.name for path in (toy.folder / "capture").iterdir()}
    copied = tmp_path / "elsewhere" / "copy"
    copied.parent.mkdir()
    shutil.copy(first / name, copied)
    found = why(copied, runs=[toy.folder / "runs"])
    assert (found.name, found.units) == (name, origin.units)
    assert repeat(origin).is_same
    (first / name).write_bytes(b"changed")
    assert why(first / name).was_changed


def test_a_file_that_was_renamed_in_its_folder_is_found_by_its_content(two: tuple[Toy, Path, Path]) -> None:
    """It was refused, as a file that the run has not written."""
    _, first, _ = two
    name = next(iter(package.load(first).summary.files))
    renamed = (first / name).rename(first / "mine.txt")
    assert (why(renamed).name, why(renamed).units) == (name, why(shutil.copy(renamed, first / name)).units)


def test_copies_of_what_no_unit_made_are_found_by_their_content(two: tuple[Toy, Path, Path], tmp_path: Path) -> None:
    """Only files that units made were found: not the report, run.json, the events, or a page that somebody was sent."""
    toy, first, _ = two
    (first / "ro-crate-metadata.json").write_text("a crate of the first run")
    page = toy.folder / "runs" / "page"
    page.mkdir()
    (page / "page.html").write_text("a page about the first run")
    Origin("share", (RunName.of(package.load(first).summary),)).write(page)
    made = [
        first / "run.json",
        first / "report.html",
        first / "logs" / "events.jsonl",
        first / "ro-crate-metadata.json",
    ]
    for file in (*made, page / "page.html"):
        copied = shutil.copy(file, tmp_path / f"copy{file.suffix}")
        found = why(copied, runs=toy.folder / "runs")
        assert (found.file, Path(found.name).name, found.units) == (copied, file.name, ())
        assert (found.out, bool(found.notes)) == (first, True)
        assert found.command == {"page.html": "share", "ro-crate-metadata.json": "crate"}.get(file.name, "")
    (tmp_path / "empty").touch()
    with pytest.raises(InputError, match="has written a file with this content"):
        why(tmp_path / "empty", runs=toy.folder / "runs")


def test_a_file_of_a_merged_run_leads_to_its_blocks(two: tuple[Toy, Path, Path], tmp_path: Path) -> None:
    """It was refused, as a file that the run has not written."""
    _, first, second = two
    merged = first.parent / "merged"
    merged.mkdir()
    (merged / "run.json").write_text(json.dumps({"stages": [], "merged": {"blocks": [str(first), str(second)]}}))
    (merged / "cloud.ply").write_text("a merged cloud")
    for file in (merged / "cloud.ply", Path(shutil.copy(merged / "cloud.ply", tmp_path / "copy.ply"))):
        found = why(file, runs=() if file.parent == merged else merged)
        assert (found.name, found.out, found.command, found.units) == ("cloud.ply", merged, "merge", ())
        assert found.notes[0].startswith(f"merged from 2 blocks: {first}, {second}")
        assert found.images == dict(package.load(first).summary.inputs)
    notes = diff(merged, first).notes
    assert any(note.startswith(f"{merged} was merged from blocks") for note in notes)


def test_files_of_the_same_content_are_named(two: tuple[Toy, Path, Path], tmp_path: Path) -> None:
    _, first, _ = two
    run = StoredRun.open(first)
    name, digest = next(iter(run.summary.files.items()))
    files = {**run.summary.files, "other/place.txt": digest}
    (first / "run.json").write_text(run.summary.model_copy(update={"files": files}).model_dump_json())
    found = why(shutil.copy(first / name, tmp_path / "copy"), runs=first)
    assert found.notes == ("other files of the run have the same content: other/place.txt",)
    assert not why(first / name).notes


def test_units_of_one_stage_take_one_line(two: tuple[Toy, Path, Path]) -> None:
    """A file of a capture of nine images had a list of 127 units."""
    _, first, _ = two
    origin = why(first / next(iter(package.load(first).summary.files)))
    lines = [line for line in origin.lines() if line.startswith("  images")]
    several = [unit for unit in origin.units if unit.stage == "images"]
    assert len(several) > 1
    assert len(lines) == 1
    assert lines[0].endswith(f"{len(several)} units")


def test_many_images_are_named_below_their_folder_and_shortened(two: tuple[Toy, Path, Path]) -> None:
    """The tiles of a tour were named without their folders, all of them: "0.png, 1.png, 0.png, …"."""
    _, first, _ = two
    origin = why(first / next(iter(package.load(first).summary.files)))
    tiles = {f"/site/tiles/{scene}/{row}.png": "" for scene in ("hall", "kitchen") for row in range(9)}
    (line,) = (line for line in replace(origin, images=tiles).lines() if line.startswith("images: "))
    assert line.startswith("images: hall/0.png, hall/1.png, ")
    assert line.endswith(" … (18 in all)")


def test_a_search_passes_files_that_cannot_be_read(
    two: tuple[Toy, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One file without permission, of the same size, ended the search in all folders."""
    toy, first, second = two
    copied = Path(shutil.copy(second / "report.html", tmp_path / "copy.html"))
    (first / "report.html").write_bytes(b" " * copied.stat().st_size)

    def refuse(path: Path) -> str:
        if path == first / "report.html":
            raise PermissionError(13, "Permission denied", str(path))
        return digest_from_file(path)

    monkeypatch.setattr("pano_mvs_lineage.why.digest_from_file", refuse)
    assert why(copied, runs=toy.folder / "runs").out == second


def test_a_file_beside_a_damaged_origin_is_found_by_its_content(two: tuple[Toy, Path, Path], tmp_path: Path) -> None:
    """It was said that the run.json of a folder cannot be read which never had one."""
    toy, first, _ = two
    name = next(iter(package.load(first).summary.files))
    (tmp_path / ".pano-mvs-origin").write_text('{"command": 5')
    copied = shutil.copy(first / name, tmp_path / "copy")
    assert why(copied, runs=toy.folder / "runs").out == first


def test_what_no_run_has_written_is_refused(two: tuple[Toy, Path, Path], tmp_path: Path) -> None:
    toy, first, _ = two
    (tmp_path / "other").write_text("nothing")
    with pytest.raises(InputError, match=r"no run in .* has written a file with this content\. Name its folder"):
        why(tmp_path / "other", runs=[toy.folder / "runs"])
    with pytest.raises(InputError, match="there is no such file"):
        why(tmp_path / "nowhere")
    (first / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="has not written this file"):
        why(first / "mine.txt")
    assert "at the end of each run" in why(first / "run.json").notes[0]


def test_a_unit_whose_code_has_changed_is_not_compared(two: tuple[Toy, Path, Path]) -> None:
    toy, first, _ = two
    origin = why(first / next(name for name in package.load(first).summary.files))
    stage = origin.units[0].use
    toy.edit("plug.py", lambda text: text.replace(f'@stage("{stage}")', f'@stage("{stage}", version=7)'))
    with pytest.raises(UsageError, match="cannot be computed again as it was"):
        repeat(origin)


def test_the_commands_print_text_and_json(two: tuple[Toy, Path, Path], pano_mvs: Command, tmp_path: Path) -> None:
    toy, first, second = two
    listed = pano_mvs("runs", toy.folder / "runs", "--csv", tmp_path / "runs.csv")
    assert listed.code == 0, listed.text
    assert "scaled.by" in listed.flat
    assert (tmp_path / "runs.csv").read_text().count("\n") == 3
    assert len(json.loads(pano_mvs("runs", toy.folder / "runs", "--json").text)["runs"]) == 2
    page = tmp_path / "page.html"
    compared = pano_mvs("diff", first, second, "--page", page)
    assert "scaled.by: 3 → 4" in compared.flat
    assert "scaled.by: 3 → 4" in page.read_text(encoding="utf-8")
    assert json.loads(pano_mvs("diff", first, second, "--json").text)["settings"][0]["name"] == "scaled.by"
    name = next(name for name in package.load(first).summary.files)
    again = pano_mvs("why", first / name, "--again")
    assert again.code == 0
    assert "the same bytes" in again.flat
    assert json.loads(pano_mvs("why", first / name, "--json").text)["units"][0]["depth"] == 0
    assert pano_mvs("diff", first, toy.folder / "nowhere").code == 2


def test_figures_are_tables() -> None:
    """They were lines of text, in which no column could be compared."""
    change = compare_ranges("a.png", np.full((8, 16), 2.0, np.float32), np.full((8, 16), 2.1, np.float32))
    found = RunDiff(
        Path("a"), Path("b"), settings=(Change("s.x", 1, 2),), metrics=(Change("s.y", 0.5, None),), ranges=(change,)
    )
    settings, metrics, ranges = found.parts()
    assert (settings.rows, settings.lines) == ((), ("s.x: 1 → 2",))
    assert (metrics.columns, metrics.rows) == (("metric", "before", "after"), (("s.y", "0.5", "–"),))
    assert ranges.columns == ("view", "differ by over 1 %", "confirmed", "seen", "filled", "only before", "only after")
    assert ranges.rows == (("a.png", "100.0%", "–", "–", "–", "0.0%", "0.0%"),)
    assert found.lines()[2:4] == ["metrics:", "  s.y: 0.5 → –"]


def test_ranges_are_compared_by_class_and_by_solid_angle() -> None:
    before = np.full((8, 16), 2.0, np.float32)
    after = before.copy()
    after[:, :4] *= 1.05
    after[:, 4:6] = np.nan
    before[:, 6:7] = np.nan
    confidence = np.full((8, 16), 200, np.uint8)
    confidence[:, :2] = 30
    confidence[:, 4:6] = 0
    found = compare_ranges("a.png", before, after, confidence=confidence)
    assert found.changed == pytest.approx(4 / 13)
    assert found.only_before == pytest.approx(2 / 16)
    assert found.only_after == pytest.approx(1 / 16)
    assert found.by_class == pytest.approx({"confirmed": 2 / 11, "filled": 1.0})
    assert found.median == 0
    assert not found.size_differs
    small = compare_ranges("a.png", before, after[::2, ::2], confidence=confidence[::2, ::2])
    assert small.size_differs
    assert "differ by more than 1 %" in str(small)


@pytest.mark.slow
def test_two_real_runs_are_compared_with_poses_and_ranges(
    quickstart: tuple[Path, str], rendered: Path, tmp_path: Path
) -> None:
    shutil.copytree(quickstart[0].with_name("cache"), tmp_path / "cache")  # which the first run only reads
    for name, planes in (("first", 32), ("second", 24)):
        package.run(
            "quickstart",
            images=rendered / "images",
            out=tmp_path / name,
            settings={"depth.planes": planes, "features.max_keypoints": 1500, "scores.truth": rendered / "truth"},
            cache=tmp_path / "cache",
        )
    found = diff(tmp_path / "first", tmp_path / "second")
    assert [change.name for change in found.settings] == ["depth.planes"]
    assert isinstance(found.poses, PoseChanges)
    assert len(found.poses.cameras) == 4
    assert not found.poses.moved
    assert len(found.ranges) == 4
    assert {*found.ranges[0].by_class} <= {"confirmed", "seen", "filled"}
    assert found.reasons["depth"].startswith("setting planes")
    assert set(found.reasons) >= {"depth", "checked", "cloud", "ranges"}
    assert not {"images", "features", "poses"} & set(found.reasons)
    page = diff_page(found)
    assert page.count("<figure>") == 4
    assert page.count("data:image/jpeg") == 12
    assert page.count('<div class="beside">') == 4
    assert page.count("<td>000.png</td>") == 1
    table = runs([tmp_path])
    assert table.settings == ("depth.planes",)
    assert "scores.median_pair_error_deg" in table.metrics
    for name in ("cloud.ply", "range/000.tiff", "colmap/sparse/0/images.bin", "preview/000.jpg"):
        origin = why(tmp_path / "first" / name)
        assert {unit.use for unit in origin.units} >= {"source.folder"}, name
        assert len(origin.images) == 4
