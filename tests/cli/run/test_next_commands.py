"""What a run says at its end: the verdict, its reasons, and commands that work when they are pasted."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import next_commands, print_summary
from pano_mvs.core.errors import InputError
from pano_mvs.engine.cache.store import Store
from pano_mvs.results.records import CloudSummary, Finding, StageOutcome, Verdict
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.session.captures import run as run_workflow
from pano_mvs.session.commands import reopen, run_command
from pano_mvs.session.session import open_session
from tests.cli.conftest import Command
from tests.engine.conftest import Toy


def commands_of(text: str) -> list[list[str]]:
    """Return the words of each command below `next:`, which must be the last lines."""
    *_, after = text.split("\nnext:\n")
    assert all(line.startswith("  pano-mvs ") for line in after.splitlines()), after
    return [shlex.split(line)[1:] for line in after.splitlines()]


@pytest.fixture
def here(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> Toy:
    """The toy, in its folder, with names that need quotes."""
    monkeypatch.setenv("COLUMNS", "60")
    (toy.folder / "my photos").mkdir()
    for number in (1, 2, 3):
        (toy.folder / "my photos" / f"{number}.txt").write_text("5")
    toy.edit("plug.py", lambda text: text.replace('"all.txt"', '"cloud.ply"'))
    return toy


def test_the_last_lines_are_the_next_commands(pano_mvs: Command, here: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(here.folder)
    ran = pano_mvs("run", "wf.yaml", "--images", "my photos", "--out", "my out", "--executor", "serial")
    assert ran.code == 0
    assert commands_of(ran.text) == [["view", "my out"]]
    assert "open my out/report.html in a browser\nnext:" in ran.text


def test_a_run_with_failures_names_the_command_that_repeats_it(
    pano_mvs: Command, here: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(here.folder)
    (here.folder / "my photos" / "2.txt").write_text("13")
    options = ["--images", "my photos", "--set", "scaled.by=4", "--out", "my out", "--cache", "my cache"]
    first = pano_mvs("run", "wf.yaml", *options, "--executor", "serial")
    assert first.code == 3
    again, _ = commands_of(first.text)
    (here.folder / "my photos" / "2.txt").write_text("14")
    repeated = pano_mvs(*again)
    assert repeated.code == 0
    assert "2 units computed" not in repeated.text
    assert commands_of(repeated.text) == [["view", "my out"]]
    stages = {stage.name: stage.params for stage in _summary(here.folder / "my out")}
    assert stages["scaled"] == {"by": 4.0}


def test_a_partial_run_names_the_command_for_the_rest(
    pano_mvs: Command, here: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(here.folder)
    ran = pano_mvs("run", "wf.yaml", "--until", "scaled", "--executor", "serial")
    (rest,) = commands_of(ran.text)
    assert rest == ["run", "wf.yaml"]
    assert "share" not in ran.text, "there is nothing to show yet"
    assert pano_mvs(*rest).code == 0


def test_verdict_and_reasons_come_before_the_next_commands(
    here: Toy, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(here.folder)
    here.run()
    session = here.session()
    output = _output(session.out, cloud=CloudSummary(points=9))
    print_summary(output, Console(), following=next_commands(output, session))
    lines = capsys.readouterr().out.splitlines()
    start = lines.index("Usable, with doubts: see below.")
    assert lines[start + 1] == "doubtful: One is odd. Look at it."
    assert lines[start + 2].startswith("results in ")
    assert lines[start + 3] == "next:"
    assert [line.split()[1] for line in lines[start + 4 :]] == ["share"]


def test_share_names_the_cache_if_another_one_is_set(finished: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    session = finished.session()
    output = _output(session.out, cloud=CloudSummary(points=9), cache=str(session.store_root))
    out = str(session.out)
    assert next_commands(output, session) == [shlex.join(["pano-mvs", "share", out, "--to", f"{out}_page"])]
    monkeypatch.setenv("PANO_MVS_CACHE", str(finished.folder / "elsewhere"))
    assert next_commands(output, session)[-1].endswith(f"--cache {session.store_root}")


def test_a_command_names_presets_and_leaves_out_defaults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PANO_MVS_CACHE", raising=False)
    assert run_command(open_session("fast")) == "pano-mvs run fast"
    (tmp_path / "photos").mkdir()
    (tmp_path / "elsewhere").mkdir()
    session = open_session("fast", images="photos", overrides=["depth.planes=48"], out="o", cache="c")
    command = "pano-mvs run fast --images photos --set depth.planes=48 --out o --cache c"
    assert run_command(session) == command
    assert run_command(session, "--only", "depth:a b") == f"{command} --only 'depth:a b'"
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert f"--images {tmp_path / 'photos'}" in run_command(session), "the folder is not here any more"
    (tmp_path / "elsewhere" / "fast.yaml").write_text("pano_mvs: 1\nextends: fast\n")
    assert run_command(open_session("fast.yaml")) == "pano-mvs run fast.yaml"


def test_an_output_folder_opens_the_session_of_its_run(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(toy.folder)
    run_workflow("wf.yaml", "capture", "out", settings={"scaled.by": 9}, cache="cache", executor="serial")
    (toy.folder / "elsewhere").mkdir()
    monkeypatch.chdir(toy.folder / "elsewhere")
    session = reopen("../out", overrides=[], images=None, cache=None)
    assert session.workflow.stages["scaled"].params.model_dump() == {"by": 9.0}
    assert session.store_root == toy.folder / "cache"
    assert session.out == Path("../out")
    (toy.folder / "wf.yaml").unlink()
    with pytest.raises(InputError, match="Give another workflow"):
        reopen("../out", overrides=[], images=None, cache=None)


def _summary(out: Path) -> tuple[StageOutcome, ...]:
    return RunSummary.read(out).stages


def _output(out: Path, **fields: object) -> RunOutput:
    """Return the output of a run with other fields in its summary, and a verdict with one reason."""
    finding = Finding("fair", "One is odd.", "Look at it.")
    verdict = Verdict("fair", "Finished", "Usable, with doubts: see below.", "", (), (finding,))
    summary = RunSummary(verdict=verdict, **fields)  # type: ignore[arg-type]
    return RunOutput(out, summary, StoredValues.of_folder(out, summary, Store(out.parent / "cache")))
