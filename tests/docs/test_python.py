"""docs/python.md and the notebook: their code runs as it stands, and names what is there."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

import pano_mvs
from pano_mvs.geometry import Rigid3
from pano_mvs.results.summary import RunSummary
from pano_mvs.session import progress
from tests.docs.pages import block, text_of

PAGE = text_of("python.md")
NOTEBOOK: dict[str, Any] = json.loads(text_of("python.ipynb"))


def run_cell(source: str, names: dict[str, Any]) -> Any:
    """Run a cell as a notebook does; return the value of its last expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    return eval(compile(ast.Expression(last.value), "cell", "eval"), names) if isinstance(last, ast.Expr) else None


def test_the_notebook_is_in_version_4_of_the_format_and_holds_no_output() -> None:
    assert (NOTEBOOK["nbformat"], NOTEBOOK["nbformat_minor"]) == (4, 5)
    assert NOTEBOOK["metadata"]["kernelspec"]["language"] == "python"
    assert len({cell["id"] for cell in NOTEBOOK["cells"]}) == len(NOTEBOOK["cells"])
    for cell in NOTEBOOK["cells"]:
        assert all(line.endswith("\n") for line in cell["source"][:-1])
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            compile("".join(cell["source"]), cell["id"], "exec")
        else:
            assert set(cell) == {"cell_type", "id", "metadata", "source"}


@pytest.mark.slow
def test_the_notebook_runs(
    tmp_path: Path, sample: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its range maps and poses are shown, and are those of the sample."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PANO_MVS_CACHE", str(sample / "cache"))
    mpl.use("agg")
    names: dict[str, Any] = {"__name__": "notebook"}
    shown = []
    for cell in NOTEBOOK["cells"]:
        if cell["cell_type"] == "code":
            shown.append(run_cell("".join(cell["source"]), names))
    printed = capsys.readouterr().out
    assert "depth" in printed
    assert "% within 5 %" in printed
    (page,) = [value._repr_html_() for value in shown if isinstance(value, pano_mvs.RunOutput)]
    assert page.count("data:image/jpeg") == 8
    (shared,) = [value for value in shown if isinstance(value, pano_mvs.Shared)]
    assert (shared.points, shared.panoramas) == (100_000, 4)
    assert len(shared._repr_html_()) < 10_000_000
    figures = [plt.figure(number) for number in plt.get_fignums()]
    assert len(figures) == 2
    assert len(figures[0].axes[0].images) == 1
    plt.close("all")
    assert names["run"].poses.names == tuple(names["run"].views)
    exec(block("python.md", "points"), names)
    points = names["points_in_world"](names["view"])
    assert np.linalg.norm(points, axis=1).max() < 100
    exec(block("python.md", "share"), names)
    exec(block("python.md", "view"), names)
    assert names["picture"].shape == (640, 960, 3)
    exec(block("python.md", "summary"), names)
    assert names["summary"] == names["run"].summary


def test_events_and_errors_that_the_page_names_are_there(capsys: pytest.CaptureFixture[str]) -> None:
    for name in re.findall(r"`([A-Z]\w+(?:Started|Finished|Failed|Warned)|Forecast|TimeLeft)`", PAGE):
        assert hasattr(progress, name)
    for name in re.findall(r"`(\w+Error)`", PAGE):
        assert issubclass(getattr(pano_mvs, name), pano_mvs.PanoMvsError)
    names: dict[str, Any] = {}
    exec(block("python.md", "progress"), names)
    names["show"](progress.Warned("it is late"))
    names["show"](progress.UnitStarted("depth", "a.jpg"))
    names["show"](progress.TimeLeft(70.0, at_least=True, done=0.25))
    assert capsys.readouterr().out == "warning: it is late\n25 %, more than 70 s left\n"


def test_the_examples_of_estimates_name_what_exists(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    exec(block("python.md", "estimator"), names)
    assert isinstance(names["left"], progress.TimeLeft)
    assert capsys.readouterr().out == "0.0 0.0 ()\n"
    for name in re.findall(r"plan\.(\w+)", block("python.md", "plan").partition("\n")[2]):
        assert hasattr(pano_mvs.RunPlan, name), name


def test_fields_that_the_page_names_are_there() -> None:
    run = pano_mvs.RunOutput
    view = pano_mvs.RunView
    for name in re.findall(r"^\| `(?:views\[name\]\.)?(\w+)` \|", PAGE.partition("## The output")[2], re.M):
        assert hasattr(run, name) or hasattr(view, name) or name in RunSummary.model_fields or name == "summary"
    for name in re.findall(r"`run\.summary\.(\w+)`", PAGE):
        assert name in RunSummary.model_fields or hasattr(RunSummary, name)


def test_the_first_example_calls_what_there_is() -> None:
    """It needs photographs that nobody has; so its calls are checked against a run that is made up."""

    class View:
        range_map = np.ones((2, 4))

    class Poses:
        centers = np.zeros((1, 3))

    def made_up(workflow: str, *, images: str, out: str, settings: dict[str, object]) -> pano_mvs.RunOutput:
        assert (workflow, images, out, settings) == ("quickstart", "photos", "out", {"images.nadir_deg": 30})
        run = object.__new__(pano_mvs.RunOutput)
        run.__dict__ |= {"summary": RunSummary(), "views": {"a.jpg": View}, "poses": Poses, "cloud": [0]}
        return run

    text = block("python.md", "example").replace("pano_mvs.run(", "made_up(")
    names: dict[str, Any] = {"made_up": made_up}
    exec(text, names)
    assert names["range_map"].shape == (2, 4)


def test_points_lie_along_the_rays() -> None:
    class View:
        range_map = np.full((4, 8), 2.0, np.float32)
        confidence = np.full((4, 8), 200, np.uint8)
        cam_from_world = Rigid3(np.eye(3), np.array([1.0, 0.0, 0.0]))

    names: dict[str, Any] = {}
    exec(block("python.md", "points"), names)
    points = names["points_in_world"](View)
    assert np.linalg.norm(points - (-1, 0, 0), axis=1) == pytest.approx(np.full(32, 2.0))
