"""Groups of cameras that nothing connects, and cameras that are doubtful."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import print_summary
from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_groups, read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from tests.cli.conftest import Command, run_json
from tests.synthetic.room_pair import LARGE, SMALL, write_workflow


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms")
    write_workflow(folder)
    return folder


@pytest.mark.slow
def test_both_rooms_are_delivered(pano_mvs: Command, rooms: Path) -> None:
    result = pano_mvs("run", rooms / "two.yaml", "--out", "out")
    assert result.code == 0, result.text
    out = Path("out")
    poses = run_json(out)["poses"]
    assert poses["registered"] == list(LARGE + SMALL)
    assert [group["images"] for group in poses["groups"]] == [list(LARGE), list(SMALL)]
    assert [group["metric"] for group in poses["groups"]] == [False, True]
    assert (poses["metric"], poses["scale"]) == (False, poses["groups"][0]["scale"])
    assert sum(group["points"] for group in poses["groups"]) == poses["points"]
    first, second, *_ = poses["groups"][1]["nearest_pair"]
    assert (first in LARGE, second in SMALL) == (True, True)
    assert "2 groups of panoramas share no reliable connection: each has its own frame and scale" in result.flat
    assert f"between {first} and {second}" in result.flat
    assert f"To connect them, take panoramas between {first} and {second}" in (out / "report.html").read_text()
    _check_models(out, rooms)
    _check_ranges(out, rooms)
    assert min(len(read_ply(out / name)) for name in ("cloud.ply", "cloud_1.ply")) > 500
    assert "0 units computed" in pano_mvs("run", rooms / "two.yaml", "--out", "out").text


def _check_models(out: Path, rooms: Path) -> None:
    truth = read_poses(rooms / "capture" / "truth")
    true = dict(zip(truth.names, truth.centers, strict=True))
    for number, names in enumerate((LARGE, SMALL)):
        model = pycolmap.Reconstruction(out / f"colmap/sparse/{number}")
        centers = {image.name: image.projection_center() for image in model.images.values()}
        assert centers.keys() == set(names)
        found, wanted = (np.linalg.norm(at[names[1]] - at[names[0]]) for at in (centers, true))
        assert found == pytest.approx((0.5 if number == 0 else 1.0) * wanted, rel=0.02)
        assert model.num_points3D() > 20
    assert [group.names for group in read_groups(out)] == [LARGE, SMALL]


def _check_ranges(out: Path, rooms: Path) -> None:
    """The large room keeps the unit that its poses had, half a metre each; the small one was scaled to metres."""
    with np.load(rooms / "capture" / "truth" / "depth.npz") as file:
        depths = dict(file)
    for name in (*LARGE, *SMALL):
        found = read_range_tiff(out / f"range/{name[:2]}.tiff")
        ratios = (found / depths[name[:2]])[np.isfinite(found) & np.isfinite(depths[name[:2]])]
        assert np.median(ratios) == pytest.approx(0.5 if name in LARGE else 1.0, rel=0.05), name
        assert (out / f"confidence/{name[:2]}.png").is_file()
        assert (out / f"preview/{name[:2]}.jpg").is_file()


def test_the_terminal_says_what_the_report_finds_of_groups(capsys: pytest.CaptureFixture[str]) -> None:
    groups = [{"images": ["a", "b", "c"]}, {"images": ["x", "y"], "nearest_pair": ["b", "x", 0, 31]}]
    poses = {"registered": [*"abcxy"], "points": 7, "scale": "its own", "groups": groups}
    print_summary(_output({"poses": poses}), Console(width=200))
    printed = capsys.readouterr().out
    assert "Usable, with doubts: see below.\ndoubtful: 2 groups of panoramas share no reliable connection" in printed
    assert "To connect them, take panoramas between b and x (31 candidates)." in printed
    print_summary(_output({"poses": poses | {"groups": groups[:1]}}), Console(width=200))
    assert "reliable connection" not in capsys.readouterr().out


def _output(summary: dict[str, object]) -> RunOutput:
    return RunOutput(Path("out"), RunSummary.from_json(summary), StoredValues())


DOUBTING = """\
from dataclasses import replace

import numpy as np

from pano_mvs.api import Context, One, Params, Poses, stage


class DoubtingParams(Params):
    doubts: dict[str, str] = {}


@stage("poses.doubting")
def doubting(poses: One[Poses], params: DoubtingParams, ctx: Context) -> Poses:
    count = len(poses.names)
    return replace(poses, doubts=params.doubts, evidence={"000.png": {"share": 0.25, "repeats": None}},
                   confirmed_shares=np.full(count, 0.25),
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
  depth:   {use: depth.sweep, planes: 32, near: 0.3, far: 10}
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
        assert summary["poses"]["evidence"] == {"000.png": {"share": 0.25, "repeats": None}}
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
@pytest.mark.parametrize("moved", ["", "003.png"])
def test_dense_results_of_the_sample_doubt_what_was_moved(pano_mvs: Command, tmp_path: Path, moved: str) -> None:
    result = pano_mvs(
        "run", write_dense(tmp_path, SAMPLE, width=512, move=moved), "--out", "out", "--set", "depth.planes=64"
    )
    assert result.code == (3 if moved else 0), result.text
    assert list(run_json(Path("out"))["poses"]["doubts"]) == ([moved] if moved else [])
