"""What `plan`, `status`, `show` and `schema` print."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import pano_mvs as package
from pano_mvs.cli.app import app
from pano_mvs.cli.check_command import watch_workflow
from pano_mvs.cli.plan_commands import _expected
from pano_mvs.core.digest import digest_from_bytes, digest_from_value
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.planning.unit_keys import _static_identity
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.editor_schema import workflow_schema
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.session.session import Session, open_session
from tests.cli.conftest import Command
from tests.engine.conftest import Toy
from tests.engine.toy import HELPER, PLUGIN
from tests.presets import usable_presets


@pytest.fixture
def here(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the toy, with a cache for all commands."""
    monkeypatch.setenv("PANO_MVS_CACHE", str(toy.folder / "cache"))
    return toy.folder


def times_as(folder: Path, seconds: float, stored_bytes: float) -> None:
    """Overwrite the times of earlier runs: each unit took `seconds`."""
    path = folder / "cache" / "unit-times.json"
    value = json.loads(path.read_bytes().partition(b"\n")[2])
    for samples in value.values():
        for sample in samples:
            sample[5:] = seconds, stored_bytes
    body = json.dumps(value)
    path.write_text(f"{digest_from_bytes(body.encode())}\n{body}")


def test_a_plan_without_experience_says_so_and_gives_no_number(pano_mvs: Command, here: Path) -> None:
    planned = pano_mvs("plan", here / "wf.yaml")
    assert planned.code == 0
    assert planned.text.count("unknown") == 2 * 9 + 1
    cells = {
        row[1].strip(): row[5].strip() for row in (line.split("│") for line in planned.text.splitlines()) if row[4:]
    }
    assert (cells["images"], cells["scaled"], cells["difference"], cells["mean"]) == ("", "5", "all", "about 5")
    assert "cannot run" not in planned.text
    assert "time and disk space: unknown, because no earlier run" in planned.flat


def test_a_plan_has_a_row_for_each_group_of_stages(pano_mvs: Command, here: Path) -> None:
    """A plan of `quality` had 44 rows, of which a reader knows nine groups."""
    own = "{use: toy.scale, in: {x: images}, by: "
    (here / "grouped.yaml").write_text(
        f"pano_mvs: 1\nextends: wf.yaml\nstages:\n  added:\n    stages:\n      again: {own}2}}\n      twice: {own}5}}\n"
    )
    command = ("plan", here / "grouped.yaml")
    planned = pano_mvs(*command)
    assert ["added", "again, twice", "", "", "10"] in rows_of(planned.text)
    assert ["", "scaled", "", "", "5"] in rows_of(planned.text), "a stage in no group has a row of its own"
    assert "11 stages in 1 group; pano-mvs plan --stages lists each" in planned.flat
    pano_mvs("run", here / "grouped.yaml", "--executor", "serial")
    planned = pano_mvs(*command, "--set", "twice.by=7")
    assert ["added", "twice", "5", "5", ""] in rows_of(planned.text)
    listed = pano_mvs(*command, "--stages")
    assert {row[0] for row in rows_of(listed.text)} >= {"again", "twice", "scaled"}
    assert "--stages" not in listed.text
    assert package.plan(here / "grouped.yaml").groups == {"added": ("again", "twice")}
    assert package.plan(here / "grouped.yaml", until="again").groups == {"added": ("again",)}


def rows_of(text: str) -> list[list[str]]:
    """Return the first five cells of each row of a table."""
    return [[cell.strip() for cell in line.split("│")[1:6]] for line in text.splitlines() if line.startswith("│")]


def test_units_that_cannot_run_have_a_column_if_there_are_any(pano_mvs: Command, here: Path) -> None:
    (here / "capture" / "9.txt").symlink_to("nowhere")
    planned = pano_mvs("plan", here / "wf.yaml")
    assert "cannot run" in planned.text.splitlines()[1]
    assert "images:9.txt: cannot run: " in planned.flat


def test_a_plan_states_times_and_disk_space_by_earlier_runs(pano_mvs: Command, here: Path) -> None:
    pano_mvs("run", here / "wf.yaml", "--executor", "serial")
    assert "nothing to compute" in pano_mvs("plan", here / "wf.yaml").text
    times_as(here, 600.0, 2e6)
    planned = pano_mvs("run", here / "wf.yaml", "--set", "scaled.by=5", "-n", "--workers", "1")
    rows = {row[1]: row[2:] for row in (line.split("│") for line in planned.text.splitlines()) if len(row) == 9}
    cells = {name.strip(): [cell.strip() for cell in row] for name, row in rows.items()}
    assert cells["images"][-3:-1] == ["", ""], "it is cached"
    assert cells["scaled"][-3:-1] == ["50 min", "10.0 MB"]
    assert cells["shifted"][-3:-1] == ["10 min", "2.0 MB"]
    hours = (5 + 4 + 1 + 5 + 5 + 1 + 1) / 6  # the last one is the report
    assert f"about {hours:.1f} h with 1 worker, and 42.0 MB in the cache, by earlier runs" in planned.flat
    assert "unknown" not in planned.text
    with_two = pano_mvs("run", here / "wf.yaml", "--set", "scaled.by=5", "--dry-run", "--threads-per-worker", "1")
    assert "by earlier runs" in with_two.flat


def test_stages_that_no_run_computed_are_named(pano_mvs: Command, here: Path) -> None:
    pano_mvs("run", here / "wf.yaml", "--executor", "serial", "--until", "mean")
    planned = pano_mvs("plan", here / "wf.yaml", "--set", "scaled.by=5")
    assert "at least" in planned.text
    assert "in the cache, by earlier runs; unknown: pairs, difference, shifted … (5 in all)" in planned.flat


def test_a_group_of_which_a_stage_is_unknown_is_not_said_to_be_dropped() -> None:
    """The disk space of a group was `dropped` although a stage of it that no run has computed keeps its results."""
    temporary = StageForecast("first", (), 0, units=2, unit_s=3.0, unit_bytes=1e6, is_temporary=True)
    assert _expected([temporary], 1) == ("6 s", "dropped")
    assert _expected([temporary, StageForecast("second", (), 0, units=2)], 1) == ("at least 6 s", "unknown")
    kept = replace(temporary, is_temporary=False)
    assert _expected([temporary, kept], 1) == ("12 s", "2.0 MB")


def test_a_dry_run_is_the_plan_and_writes_nothing(pano_mvs: Command, here: Path) -> None:
    options = ["--set", "scaled.by=5", "--until", "mean", "--out", here / "new"]
    planned = pano_mvs("plan", here / "wf.yaml", *options)
    dry = pano_mvs("run", here / "wf.yaml", *options, "--dry-run")
    assert (dry.code, dry.text) == (0, planned.text)
    assert not (here / "new").exists()
    refused = pano_mvs("run", here / "wf.yaml", "--dry-run", "--out", here / "capture")
    assert (refused.code, "reads this folder" in refused.flat) == (2, True)
    assert pano_mvs("run", here / "wf.yaml", "--dry-run", "--json").code == 2


def test_status_of_an_output_folder_needs_nothing_else(
    pano_mvs: Command, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PANO_MVS_CACHE")
    (here / "capture" / "3.txt").write_text("13")
    options = ["--set", "scaled.by=5", "--out", here / "out", "--cache", here / "c", "--executor", "serial"]
    assert pano_mvs("run", here / "wf.yaml", *options).code == 3
    found = pano_mvs("status", here / "out")
    assert found.code == 0
    assert "exit code 3" in found.text
    assert "thirteen is unlucky" in found.flat
    assert "would run, and" in found.flat
    assert "cannot run" not in found.text, "a failed unit is tried again"
    (here / "capture" / "3.txt").write_text("30")
    command = shlex.split(pano_mvs("status", here / "out").text.split("to compute this:\n")[1])
    assert command[:2] == ["pano-mvs", "run"]
    assert pano_mvs(*command[1:]).code == 0
    assert "nothing to compute" in pano_mvs("status", here / "out").text
    changed = pano_mvs("status", here / "out", "--set", "scaled.by=6")
    assert "param by 5.0 → 6.0" in changed.text


def test_status_of_a_workflow_takes_settings(pano_mvs: Command, here: Path) -> None:
    options = ["--set", "scaled.by=5", "--out", here / "out"]
    assert "no finished run in" in pano_mvs("status", here / "wf.yaml", *options).text
    pano_mvs("run", here / "wf.yaml", *options, "--executor", "serial")
    found = pano_mvs("status", here / "wf.yaml", *options)
    assert "exit code 0" in found.text
    assert "nothing to compute" in found.text
    assert "5 units would run" in pano_mvs("status", here / "wf.yaml", "--out", here / "out").text


def test_status_of_a_folder_that_holds_no_run_or_lost_its_workflow(pano_mvs: Command, here: Path) -> None:
    missing = pano_mvs("status", here / "nowhere")
    assert (missing.code, "there is no output folder" in missing.flat) == (2, True)
    refused = pano_mvs("status", here / "capture")
    assert refused.code == 2
    assert "Give the output folder of a run" in refused.flat
    pano_mvs("run", here / "wf.yaml", "--out", here / "out", "--executor", "serial")
    (here / "wf.yaml").unlink()
    lost = pano_mvs("status", here / "out")
    assert lost.code == 2
    assert "exit code 0" in lost.text
    assert "Give another workflow" in lost.flat


def explain(toy: Toy, unit: str) -> str:
    arguments = ["plan", str(toy.folder / "wf.yaml"), "--cache", str(toy.folder / "cache"), "--explain", unit]
    return " ".join(CliRunner().invoke(app, arguments).output.split())


def test_explain_names_settings_inputs_and_the_result(finished: Toy) -> None:
    text = explain(finished, "mean:2.txt")
    assert "mean:2.txt: cached" in text
    assert "reads around: 1.txt" in text
    place = text.split("result Mean.meta: ")[1].split(" (")[0]
    assert Path(place).is_file()


def test_explain_says_why_a_unit_would_run(finished: Toy) -> None:
    finished.edit("wf.yaml", lambda text: text.replace("by: 3", "by: 4"))
    assert "scaled:1.txt: would run: param by 3.0 → 4.0" in explain(finished, "scaled:1.txt")
    assert "waits for outputs" in explain(finished, "mean:1.txt")


@pytest.mark.parametrize(("unit", "message"), [("nowhere", "no stage"), ("scaled:9.txt", "has no unit")])
def test_explain_of_nothing_names_what_there_is(finished: Toy, unit: str, message: str) -> None:
    assert message in explain(finished, unit)


def test_plan_takes_the_out_of_a_run_and_writes_nothing_there(toy: Toy) -> None:
    """One can put `plan` in the place of `run` in one's own command."""
    command = ["plan", str(toy.folder / "wf.yaml"), "--cache", str(toy.folder / "cache"), "--out"]
    planned = CliRunner().invoke(app, [*command, str(toy.folder / "new")])
    assert planned.exit_code == 0
    assert "units would run" in planned.output
    assert not (toy.folder / "new").exists()
    refused = CliRunner().invoke(app, [*command, str(toy.folder / "capture")])
    assert refused.exit_code == 2, "as a run would be"
    assert "reads this folder" in " ".join(refused.output.split())


PRESETS = [path.stem for path in usable_presets()]


def resolved_session(session: Session, folder: Path, name: str = "all.yaml") -> Session:
    """Return the session of a workflow's resolved form."""
    path = folder / name
    path.write_text(resolved_yaml(session.workflow, session.graph), encoding="utf-8")
    return open_session(path, cache=session.store_root, out=session.out)


def identities(session: Session, store: Store) -> dict[str, object]:
    """Return what the keys of each stage are made of, without its inputs, and where these come from."""
    return {
        name: (
            digest_from_value(_static_identity(entry, store)),
            {port: edge.producer for port, edge in session.graph.edges[name].items()},
            entry.policy.model_dump(exclude={"inputs"}),
        )
        for name, entry in session.workflow.stages.items()
    }


@pytest.mark.parametrize("preset", PRESETS)
def test_a_resolved_preset_has_the_same_keys(preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    session = open_session(preset)
    again = resolved_session(session, tmp_path)
    store = Store(tmp_path / "cache")
    assert identities(again, store) == identities(session, store)
    assert list(again.workflow.stages) == list(session.workflow.stages)
    assert again.workflow.id == session.workflow.id
    assert resolved_yaml(again.workflow, again.graph) == resolved_yaml(session.workflow, session.graph)


def test_every_setting_is_there_with_its_value(pano_mvs: Command, tmp_path: Path) -> None:
    shown = pano_mvs("show", "quality", "--resolved", "--set", "depth.planes=77").text
    assert "    planes: 77\n" in shown
    assert "    near: null\n" in shown
    assert "    cost: census_gradient\n" in shown
    depth = open_session("quality").workflow.stages["depth"].params
    assert all(f"    {name}: " in shown for name in type(depth).model_fields)
    written = pano_mvs("show", "quality", "--resolved", "--set", "depth.planes=77", "--out", tmp_path / "mine.yaml")
    assert (written.code, written.text) == (0, f"written to {tmp_path / 'mine.yaml'}\n")
    assert (tmp_path / "mine.yaml").read_text() == shown
    assert pano_mvs("check", tmp_path / "mine.yaml").code == 0
    again = pano_mvs("show", "fast", "--out", tmp_path / "mine.yaml")
    assert (again.code, "such a file already" in again.flat) == (2, True)
    assert (tmp_path / "mine.yaml").read_text() == shown
    (tmp_path / "file").touch()
    refused = pano_mvs("show", "quality", "--out", tmp_path / "file" / "mine.yaml")
    assert (refused.code, "cannot be written" in refused.flat) == (2, True)


def test_a_resolved_workflow_depends_on_no_other_file_and_computes_nothing_again(
    pano_mvs: Command, toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(toy.folder)  # where its paths are relative
    (toy.folder / "top.yaml").write_text(
        "pano_mvs: 1\nname: toy\nextends: wf.yaml\n"
        "stages: {scaled: {by: 5, retries: 2}, mean: {min_success: 0.5}, all: null}\n"
    )
    options = ["--cache", toy.folder / "cache", "--out", toy.folder / "out", "--executor", "serial"]
    assert pano_mvs("run", "top.yaml", *options).code == 0
    shown = pano_mvs("show", "top.yaml", "--resolved").text
    assert "retries: 2" in shown
    assert "min_success: 0.5" in shown
    assert "extends" not in shown
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "all.yaml").write_text(shown)
    monkeypatch.chdir(elsewhere)
    again = pano_mvs("run", "all.yaml", *options)
    assert again.code == 0
    assert "(nothing to compute)" in again.text


def test_a_workflow_is_shown_as_its_groups(pano_mvs: Command, toy: Toy) -> None:
    shown = pano_mvs("show", "quality").text
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in shown.splitlines() if line.startswith("│")]
    assert [row[0] for row in rows] == [
        *("source", "masks", "keypoints", "matching", "cameras", "sweep", "filters", "layout", "exports")
    ]
    assert rows[4][1] == "camera poses, verified, refined and levelled"
    assert rows[4][2].startswith("poses, verified, refined, levelled")  # and house, which a plugin offers
    assert f"{len(open_session('quality').workflow.stages)} stages; --resolved prints them" in shown
    beside = pano_mvs("show", toy.folder / "wf.yaml").text
    assert "│       │ Multiply." in beside
    assert "9 stages" in beside


def test_the_files_are_shown_as_they_are(pano_mvs: Command, toy: Toy) -> None:
    text = "pano_mvs: 1\nextends: wf.yaml  # mine\nstages: {scaled: {by: 5}}\n"
    (toy.folder / "top.yaml").write_text(text)
    shown = pano_mvs("show", toy.folder / "top.yaml", "--text").text
    assert shown.startswith(text)
    assert f"# extended: {toy.folder / 'wf.yaml'}" in shown
    assert "toy.difference" in shown
    refused = pano_mvs("show", "nowhere")
    assert (refused.code, "no workflow file 'nowhere'" in refused.flat) == (2, True)


READER = '''
from pano_mvs.api import All, Files, Panorama, Params, stage


class TextParams(Params):
    text: str = ""
    number: float = 0.0
    texts: tuple[str, ...] = ()
    table: dict[str, float | None] = {}


@stage("odd.text")
def text(images: All[Panorama], params: TextParams) -> Files:
    """Nothing."""
    return Files({})
'''


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("odd")
    (folder / "images").mkdir()
    (folder / "odd.py").write_text(READER)
    return folder


WORDS = st.text(st.characters(min_codepoint=32, max_codepoint=0x2FF, exclude_categories=("C", "Z")) | st.just(" "))
TRICKY = st.sampled_from(["null", "~", "yes", "no", "1", "1e5", "0x10", "0o7", "- a", "a: b", "#", "''", " a ", ".inf"])


@pytest.mark.slow
@settings(max_examples=20)
@given(
    text=WORDS | TRICKY,
    number=st.floats(allow_nan=False, allow_infinity=False),
    texts=st.lists(WORDS | TRICKY, max_size=3),
    table=st.dictionaries(st.sampled_from(["a", "null", "1", "y"]), st.none() | st.floats(-1e300, 1e300), max_size=3),
)
def test_any_values_survive(
    odd: Path, text: str, number: float, texts: list[str], table: dict[str, float | None]
) -> None:
    path = odd / "wf.yaml"
    path.write_text(
        "pano_mvs: 1\nname: odd\nplugins: [odd.py]\n"
        "stages:\n  images: {use: source.folder, path: images}\n  odd: {use: odd.text}\n"
    )
    session = open_session(path, cache=odd / "cache")
    entry = session.workflow.stages["odd"]
    params = type(entry.params).model_validate({"text": text, "number": number, "texts": tuple(texts), "table": table})
    object.__setattr__(entry, "params", params)
    again = resolved_session(session, odd)
    assert again.workflow.stages["odd"].params.model_dump() == params.model_dump()


def test_to_the_standard_output_and_to_a_file(pano_mvs: Command) -> None:
    printed = pano_mvs("schema")
    assert printed.code == 0
    written = pano_mvs("schema", "--out", "pano-mvs.schema.json")
    assert written.code == 0
    assert "# yaml-language-server: $schema=pano-mvs.schema.json" in written.flat
    schema = json.loads(Path("pano-mvs.schema.json").read_text(encoding="utf-8"))
    assert json.loads(printed.text) == schema == workflow_schema(Registry.installed())


def test_of_a_workflow_that_is_being_written(pano_mvs: Command) -> None:
    """Its plugins and what it extends count, though it has mistakes of its own."""
    Path("plug.py").write_text(PLUGIN)
    Path("helper.py").write_text(HELPER)
    Path("mine.yaml").write_text("pano_mvs: 1\nextends: quickstart\nplugins: [plug.py]\nstages: {depth: {plan: 1}}\n")
    result = pano_mvs("schema", "mine.yaml")
    assert result.code == 0, result.text
    schema = json.loads(result.text)
    assert "toy.scale" in schema["$defs"]["stage"]["else"]["properties"]["use"]["enum"]
    assert "depth" in schema["properties"]["stages"]["properties"]


def test_where_it_cannot_be_written_or_read(pano_mvs: Command) -> None:
    Path("file").touch()
    assert pano_mvs("schema", "--out", "file/schema.json").code == 2
    assert pano_mvs("schema", "nothing").code == 2
    Path("bad.yaml").write_text("[")
    assert pano_mvs("schema", "bad.yaml").code == 2


GROUP_FILE = "pano_mvs: 1\nstages:\n  again: {use: toy.scale}\n"
NEW_PLUGIN = 'from pano_mvs.api import Pairs, stage\n\n\n@stage(\'a.b\')\ndef f() -> Pairs:\n    """Nothing."""\n'


@pytest.mark.parametrize("as_json", [False, True])
def test_a_workflow_is_checked_again_after_each_change_of_its_files(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], as_json: bool
) -> None:
    """Also of a file that it extends, and of a plugin; a mistake does not end it, and Ctrl-C does."""
    monkeypatch.chdir(toy.folder)
    (toy.folder / "child.yaml").write_text("pano_mvs: 1\nextends: wf.yaml\nstages: {scaled: {by: 5}}\n")
    changes: list[Callable[[], object]] = [
        lambda: toy.edit("wf.yaml", lambda text: text.replace("use: toy.scale", "use: toy.scael")),
        lambda: toy.edit("wf.yaml", lambda text: text.replace("use: toy.scael", "use: toy.scale")),
        lambda: toy.edit("plug.py", lambda text: f"{text}\nraise ValueError('broken')\n"),
        lambda: Path("child.yaml").unlink(),
    ]

    def sleep(_seconds: float) -> None:
        if not changes:
            raise KeyboardInterrupt
        changes.pop(0)()

    with pytest.raises(KeyboardInterrupt):
        watch_workflow("child.yaml", [], None, as_json=as_json, sleep=sleep)
    shown = capsys.readouterr()
    if as_json:
        found = [json.loads(line) for line in shown.out.splitlines()]
        assert [(one["ok"], one["stages"]) for one in found] == [(True, 9), (False, 0), (True, 9), *[(False, 0)] * 2]
        assert not shown.err
    else:
        assert shown.out.count("no mistakes") == 2
    mistakes = shown.out if as_json else shown.err
    assert "there is no stage 'toy.scael'" in mistakes
    assert "broken" in mistakes
    assert "there is no workflow file 'child.yaml'" in mistakes


@pytest.mark.parametrize(
    ("entry", "file", "wrong", "right"),
    [
        (
            "extends: below.yaml",
            "below.yaml",
            "pano_mvs: 1\nextends: wf.yaml\nstages: [",
            "pano_mvs: 1\nextends: wf.yaml\n",
        ),
        ("extends: below.yaml", "below.yaml", None, "pano_mvs: 1\nextends: wf.yaml\n"),
        ("extends: wf.yaml\nstages: {more: {group: more.yaml}}", "more.yaml", None, GROUP_FILE),
        ("extends: wf.yaml\nstages: {more: {group: more.yaml}}", "more.yaml", f"{GROUP_FILE}    b: [\n", GROUP_FILE),
        ("extends: wf.yaml\nplugins: [new.py]", "new.py", None, NEW_PLUGIN),
        ("extends: wf.yaml\nplugins: [new.py]", "new.py", "def f(:\n", NEW_PLUGIN),
    ],
)
def test_a_first_check_that_fails_watches_all_files(
    toy: Toy,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    entry: str,
    file: str,
    wrong: str | None,
    right: str,
) -> None:
    """Only the main file was watched if the mistake was in another one, or another one was missing."""
    monkeypatch.chdir(toy.folder)
    Path("child.yaml").write_text(f"pano_mvs: 1\n{entry}\n")
    if wrong is not None:
        Path(file).write_text(wrong)
    changes: list[Callable[[], object]] = [lambda: Path(file).write_text(right)]

    def sleep(_seconds: float) -> None:
        if not changes:
            raise KeyboardInterrupt
        changes.pop(0)()

    with pytest.raises(KeyboardInterrupt):
        watch_workflow("child.yaml", [], None, sleep=sleep)
    shown = capsys.readouterr()
    assert "error:" in shown.err
    assert shown.out.count("no mistakes") == 1


def test_a_change_during_a_check_is_not_missed(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(toy.folder)
    changes: list[Callable[[], object]] = [
        lambda: toy.edit("wf.yaml", lambda text: text.replace("use: toy.scale", "use: toy.scael"))
    ]

    def changed_meanwhile(*arguments: Any, **settings: Any) -> Session:
        session = open_session(*arguments, **settings)
        while changes:
            changes.pop()()
        return session

    def sleep(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pano_mvs.cli.check_command.open_session", changed_meanwhile)
    with pytest.raises(KeyboardInterrupt):
        watch_workflow("wf.yaml", [], None, sleep=sleep)
    shown = capsys.readouterr()
    assert shown.out.count("no mistakes") == 1
    assert "there is no stage 'toy.scael'" in shown.err
