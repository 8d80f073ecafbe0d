"""Doubtful cameras: exit code 3, said once, in the terminal, in run.json and the report; found by dense results too."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.conftest import Command, run_json

DOUBTING = """\
from dataclasses import replace

import numpy as np

from pano_mvs.api import Context, One, Params, Poses, stage


class DoubtingParams(Params):
    doubts: dict[str, str] = {}


@stage("poses.doubting")
def doubting(poses: One[Poses], params: DoubtingParams, ctx: Context) -> Poses:
    count = len(poses.names)
    return replace(poses, doubts=params.doubts, confirmed_shares=np.full(count, 0.25),
                   expected_shares=np.array([0.5] * (count - 1) + [np.nan]),
                   right_probabilities=np.array([0.9] * (count - 1) + [np.nan]))
"""

POSES_ONLY = """\
pano_mvs: 1
plugins: [doubting.py]
stages:
  images:   {use: source.folder, path: capture/images}
  poses:    {use: poses.from_model, path: capture/truth/poses.json}
  doubting: {use: poses.doubting, doubts: {001.png: the images see nothing of it where it stands}}
  again:    {use: poses.doubting, doubts: {001.png: the images see nothing of it where it stands}}
"""

DENSE = """\
pano_mvs: 1
stages:
  images:  {use: source.folder, path: IMAGES, max_width: WIDTH}
  poses:   {use: poses.from_model, path: poses.json}
  views:   {use: views.nearest}
  depth:   {use: depth.sweep, planes: 32}
  checked: {use: filters.consistency}
  median:  {use: filters.median}
"""

SAMPLE = Path(__file__).parents[3] / "workflows" / "samples" / "classroom"


@pytest.fixture
def doubting(capture: Path) -> Path:
    (capture.parent / "doubting.py").write_text(DOUBTING)
    path = capture.parent / "doubting.yaml"
    path.write_text(POSES_ONLY)
    return path


def write_dense(folder: Path, capture: Path, *, width: int, move: str = "") -> Path:
    """Write a workflow for known poses, and the true poses but for one camera that stands half a metre off."""
    truth = json.loads((capture / "truth" / "poses.json").read_text())
    for view in truth["views"]:
        if Path(view["image"]).name == move:
            view["t"] = (np.array(view["t"]) + np.array(view["R"]) @ [0.35, 0.0, 0.35]).tolist()
    (folder / "poses.json").write_text(json.dumps(truth))
    path = folder / "dense.yaml"
    path.write_text(DENSE.replace("IMAGES", str(capture / "images")).replace("WIDTH", str(width)))
    return path


def test_a_doubtful_camera_is_said_once_and_the_run_ends_with_code_3_every_time(
    pano_mvs: Command, doubting: Path
) -> None:
    for computed in (7, 0):
        result = pano_mvs("run", doubting, "--out", "out")
        assert result.code == 3, result.text
        assert result.flat.count("see nothing of it where it stands") == 1
        assert "Usable, with doubts: see below. doubtful: 1 camera is doubtful: 001.png (the images see" in result.flat
        summary = run_json(Path("out"))
        assert (summary["exit_code"], summary["units"]["run"]) == (3, computed)
        assert summary["doubts"] == {
            "001.png": {"stage": "again", "reason": "the images see nothing of it where it stands"}
        }
        assert summary["poses"]["doubts"] == {"001.png": "the images see nothing of it where it stands"}
        assert summary["poses"]["confirmed"] == {
            "000.png": [0.25, 0.5],
            "001.png": [0.25, 0.5],
            "002.png": [0.25, 0.5],
            "003.png": [0.25, None],
        }
        assert summary["poses"]["p_right"] == {"000.png": 0.9, "001.png": 0.9, "002.png": 0.9, "003.png": None}


def test_a_camera_that_a_later_stage_clears_is_not_doubted(pano_mvs: Command, doubting: Path) -> None:
    result = pano_mvs("run", doubting, "--out", "out", "--set", "again.doubts={}")
    assert result.code == 0, result.text
    assert "doubtful" not in result.flat
    assert "The result looks reliable." in result.flat
    assert run_json(Path("out"))["poses"]["doubts"] == {}


@pytest.mark.slow
def test_dense_results_doubt_a_camera_in_the_wrong_place_alone(pano_mvs: Command, capture: Path) -> None:
    result = pano_mvs("run", write_dense(capture.parent, capture, width=192), "--out", "out")
    assert result.code == 0, result.text
    assert run_json(Path("out"))["doubts"] == {}
    for computed in (True, False):
        path = write_dense(capture.parent, capture, width=192, move="002.png")
        result = pano_mvs("run", path, "--out", "out")
        assert result.code == 3, result.text
        summary = run_json(Path("out"))
        assert bool(summary["units"]["run"]) == computed
        assert list(summary["poses"]["doubts"]) == ["002.png"]
        assert summary["doubts"]["002.png"]["stage"] == "checked"
        assert "in one direction" in result.flat


def test_programs_are_told_the_verdict_and_the_doubts(pano_mvs: Command, doubting: Path) -> None:
    result = pano_mvs("run", doubting, "--out", "out", "--json", "--executor", "serial")
    assert result.code == 3, result.text
    last = json.loads(result.text.splitlines()[-1])
    assert (last["event"], last["exit_code"]) == ("run_finished", 3)
    assert last["doubts"] == {"001.png": "the images see nothing of it where it stands"}
    assert (last["verdict"]["mood"], last["verdict"]["judgement"]) == ("fair", "Usable, with doubts: see below.")
    assert last["verdict"]["findings"][0]["text"].startswith("1 camera is doubtful: 001.png (")


@pytest.mark.slow
@pytest.mark.parametrize("moved", ["", "000.png", "003.png"])
def test_dense_results_of_the_sample_doubt_what_was_moved(pano_mvs: Command, tmp_path: Path, moved: str) -> None:
    result = pano_mvs(
        "run", write_dense(tmp_path, SAMPLE, width=512, move=moved), "--out", "out", "--set", "depth.planes=64"
    )
    assert result.code == (3 if moved else 0), result.text
    assert list(run_json(Path("out"))["poses"]["doubts"]) == ([moved] if moved else [])
