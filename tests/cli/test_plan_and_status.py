"""`plan`, `run --dry-run` and `status`: what would be computed, what it would take, and what the latest run did."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.core.digest import digest_from_bytes
from tests.cli.conftest import Command
from tests.engine.conftest import Toy


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
