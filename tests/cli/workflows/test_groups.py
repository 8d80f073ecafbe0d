"""Groups of cameras that nothing connects, and cameras that are doubtful."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from pano_mvs_viewer.shown_scene import open_scene

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import print_summary
from pano_mvs.geometry import Similarity3, rotation_from_rotvec
from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_groups, read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene.image_file import write_png
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.cli.conftest import Command, run_json
from tests.stored import write_npz

SIZE_HW = (96, 192)
LARGE, SMALL = ("a0.png", "a1.png", "a2.png"), ("b0.png", "b1.png")
# Another unit and another world than the truth's, as any solver would find.
WORLDS = {
    "a": Similarity3(0.5, rotation_from_rotvec([0.05, 0.3, 0.0]), np.array([1.0, 0.0, 2.0])),
    "b": Similarity3(2.0, rotation_from_rotvec([0.0, -1.0, 0.1]), np.array([0.0, -1.0, 0.0])),
}

SOLVER = """\
from pano_mvs.api import All, Context, InputPath, Panorama, Params, Poses, stage
from pano_mvs.io.poses.files import read_poses
from pano_mvs.scene.pose_groups import join_groups


class TwoRoomsParams(Params):
    path: InputPath


@stage("poses.two_rooms")
def two_rooms(images: All[Panorama], params: TwoRoomsParams, ctx: Context) -> Poses:
    rooms = [read_poses(params.path / f"{room}.json") for room in "ba"]
    return join_groups(rooms, order=tuple(images))
"""

WORKFLOW = """\
pano_mvs: 1
plugins: [two_rooms.py]
stages:
  images:   {use: source.folder, path: capture/images}
  features: {use: features.orb_tangent, max_keypoints: 600}
  pairs:    {use: pairs.exhaustive}
  matches:  {use: matches.brute_force}
  poses:    {use: poses.two_rooms, path: rooms}
  points:   {use: poses.triangulate}
  refined:  {use: poses.refine}
  metres:   {use: poses.scale, baseline: {from: b0.png, to: b1.png, metres: METRES}}
  views:    {use: views.nearest}
  depth:    {use: depth.sweep, planes: 32}
  checked:  {use: filters.consistency}
  cloud:    {use: fusion.vote}
  colmap:   {use: export.colmap}
  ply:      {use: export.ply}
  ranges:   {use: export.ranges}
  previews: {use: export.previews}
  scores:   {use: evaluate.truth, truth: capture/truth}
"""


def write_rooms(folder: Path) -> float:
    """Write the pictures and the truth of two rooms, and the poses of each in its own world; return b's baseline."""
    (folder / "capture" / "images").mkdir(parents=True)
    (folder / "capture" / "truth").mkdir()
    (folder / "rooms").mkdir()
    views: list[dict[str, Any]] = []
    depths: dict[str, NDArray[np.float32]] = {}
    ours: dict[str, list[dict[str, Any]]] = {"a": [], "b": []}
    poses = dict(
        zip(LARGE + SMALL, [*capture_poses(3, spread=0.4), *capture_poses(2, seed=3, spread=0.4)], strict=True)
    )
    for name, pose in poses.items():
        picture, depths[name[:2]] = render(default_room(seed=ord(name[0])), pose, SIZE_HW, supersample=1)
        write_png(folder / "capture" / "images" / name, picture)
        views.append({"image": name, "R": pose.rotation.tolist(), "t": pose.translation.tolist()})
        moved = WORLDS[name[0]].move_camera(pose)
        ours[name[0]].append({"image": name, "R": moved.rotation.tolist(), "t": moved.translation.tolist()})
    size = {"width": SIZE_HW[1], "height": SIZE_HW[0]}
    (folder / "capture" / "truth" / "poses.json").write_text(json.dumps({**size, "metric": True, "views": views}))
    write_npz(folder / "capture" / "truth" / "depth.npz", depths)
    for room, listed in ours.items():
        (folder / "rooms" / f"{room}.json").write_text(json.dumps({**size, "metric": False, "views": listed}))
    return float(np.linalg.norm(poses["b0.png"].center - poses["b1.png"].center))


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms")
    metres = write_rooms(folder)
    (folder / "two_rooms.py").write_text(SOLVER)
    (folder / "two.yaml").write_text(WORKFLOW.replace("METRES", f"{metres:.6f}"))
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
    _check_clouds(out, rooms)
    _check_evaluation(pano_mvs, out, rooms)
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


def _check_clouds(out: Path, rooms: Path) -> None:
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
@pytest.mark.parametrize("moved", ["", "000.png", "003.png"])
def test_dense_results_of_the_sample_doubt_what_was_moved(pano_mvs: Command, tmp_path: Path, moved: str) -> None:
    result = pano_mvs(
        "run", write_dense(tmp_path, SAMPLE, width=512, move=moved), "--out", "out", "--set", "depth.planes=64"
    )
    assert result.code == (3 if moved else 0), result.text
    assert list(run_json(Path("out"))["poses"]["doubts"]) == ([moved] if moved else [])
