from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from tests.engine.conftest import Toy


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
