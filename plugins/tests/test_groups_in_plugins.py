"""Groups of cameras that nothing connects, as the viewer shows them and as evaluation scores them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pano_mvs_viewer.shown_scene import open_scene

from pano_mvs.io.ply import read_ply
from tests.cli.conftest import Command, run_json
from tests.synthetic.room_pair import LARGE, SMALL, write_workflow


@pytest.mark.slow
def test_both_rooms_are_shown_and_scored(pano_mvs: Command, tmp_path: Path) -> None:
    rooms, out = tmp_path / "rooms", Path("out")
    workflow = write_workflow(rooms, "  scores:   {use: evaluate.truth, truth: capture/truth}\n")
    result = pano_mvs("run", workflow, "--out", out)
    assert result.code == 0, result.text
    _check_clouds(out)
    _check_evaluation(pano_mvs, out, rooms)
    assert "0 units computed" in pano_mvs("run", workflow, "--out", out).text


def _check_clouds(out: Path) -> None:
    clouds = [read_ply(out / name) for name in ("cloud.ply", "cloud_1.ply")]
    assert min(map(len, clouds)) > 500
    for number, cloud in enumerate(clouds):
        scene = open_scene(out, group=number)
        assert scene.cloud is not None
        assert scene.cloud.count == len(cloud)
        assert [camera.name for camera in scene.cameras] == [list(LARGE), list(SMALL)][number]
        assert scene.unit == ("scene units", "m")[number]
        assert f"this is group {number} of 2" in scene.notes[0]


def _check_evaluation(pano_mvs: Command, out: Path, rooms: Path) -> None:
    scores = run_json(out)["scores"]
    assert (scores["poses"]["registered"], scores["poses"]["registered_in_one_frame"]) == (5, 3)
    assert all(view["median_relative_error"] < 0.05 for view in scores["views"].values())
    told = pano_mvs("evaluate", "run", out, "--truth", rooms / "capture" / "truth")
    assert told.code == 0, told.text
    assert "5 of 5 registered (3 in one frame), median pair error" in told.flat
    assert "the poses are in 2 groups, each with its own frame and scale" in told.flat
    depth = pano_mvs("evaluate", "depth", out, "--truth", rooms / "capture" / "truth", "--json")
    views = json.loads(depth.text)["views"]
    assert views["a0"]["scale"] == pytest.approx(2.0, rel=0.02)
    assert views["b0"]["scale"] == pytest.approx(1.0, rel=0.02)
    poses = pano_mvs("evaluate", "poses", out, "--truth", rooms / "capture" / "truth" / "poses.json")
    assert "1 further group of 2 images" in poses.flat
