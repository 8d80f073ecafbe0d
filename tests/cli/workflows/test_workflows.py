"""The presets: what they deliver, on their samples and on small captures."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh

from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.session.session import open_session, presets_folder
from pano_mvs.testing.room import capture_poses, default_room, range_along
from tests.cli.conftest import SIZE_HW, SMALL, Command, deliverables, run_json
from tests.cli.truth import constant_errors, pose_errors, range_errors
from tests.stored import read_picture
from tools.benchmarks.colmap_dense import fused_points


def known(capture: Path) -> tuple[str, ...]:
    """Options that point known_poses at a rendered capture and its truth."""
    truth = capture / "truth"
    paths = ("--set", f"poses.path={truth / 'poses.json'}", "--set", f"scores.truth={truth}")
    return ("--images", str(capture / "images"), *paths, *SMALL)


NAMES = ["000", "001", "002", "003"]
FEW_RANGES = ("--set", "views.sources=2", "--set", "depth.near=0.4", "--set", "depth.far=6")


@pytest.mark.slow
def test_quickstart_writes_what_the_contract_promises(quickstart: tuple[Path, str]) -> None:
    out, _ = quickstart
    model = {f"colmap/sparse/0/{name}.bin" for name in ("cameras", "images", "points3D", "rigs", "frames")}
    views = {
        f"{folder}/{name}.{suffix}"
        for name in NAMES
        for folder, suffix in (("range", "tiff"), ("confidence", "png"), ("uncertainty", "tiff"), ("preview", "jpg"))
    }
    files = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert files == model | views | {
        "cloud.ply",
        "report.html",
        "run.json",
        "logs/code.json",
        "logs/events.jsonl",
        ".pano-mvs-output",
    }


def test_quickstart_tells_where_the_results_are(quickstart: tuple[Path, str]) -> None:
    out, text = quickstart
    assert str(out) in "".join(text.split())


def test_quickstart_recovers_poses_and_ranges(quickstart: tuple[Path, str], rendered: Path) -> None:
    poses = pose_errors(quickstart[0], rendered / "truth")
    assert poses.registered == 4
    assert poses.median_pair_deg < 0.3
    assert poses.scale_ratio_max < 0.03
    constants = constant_errors(rendered / "truth")
    for name, errors in range_errors(quickstart[0], rendered / "truth").items():
        assert errors.psnr_db > max(constant.psnr_db for constant in constants[name]) + 6
        assert errors.near > 0.6
        assert errors.completeness > 0.95


def test_poses_are_solved_once_where_sift_suffices(quickstart: tuple[Path, str]) -> None:
    """The pairs that matches.merge returned had other keys than those of SIFT, of which they are made."""
    stages = {stage["name"]: (stage["run"], stage["cached"]) for stage in run_json(quickstart[0])["stages"]}
    assert (stages["sift_poses"], stages["rematched"], stages["poses"]) == ((1, 0), (0, 0), (0, 1))


def test_ranges_and_confidences_fit_together(quickstart: tuple[Path, str]) -> None:
    out, _ = quickstart
    for name in NAMES:
        ranges = read_range_tiff(out / f"range/{name}.tiff")
        confidence = read_picture(out / f"confidence/{name}.png", cv2.IMREAD_UNCHANGED)
        assert ranges.shape == confidence.shape == SIZE_HW
        np.testing.assert_array_equal(np.isfinite(ranges), confidence > 0)
        assert (confidence >= 128).mean() > 0.3


def test_model_is_read_by_colmap_with_names_of_the_capture(quickstart: tuple[Path, str]) -> None:
    model = pycolmap.Reconstruction(str(quickstart[0] / "colmap/sparse/0"))
    assert sorted(image.name for image in model.images.values()) == [f"{name}.png" for name in NAMES]
    assert {camera.model.name for camera in model.cameras.values()} == {"EQUIRECTANGULAR"}
    assert model.num_points3D() > 50
    assert model.compute_mean_reprojection_error() < 1.0


def test_first_baseline_has_length_one(quickstart: tuple[Path, str]) -> None:
    poses = run_json(quickstart[0])["poses"]
    centers = np.array(poses["centers"])
    assert np.isclose(np.linalg.norm(centers[1:] - centers[0], axis=1), 1).any()
    assert poses["metric"] is False
    assert "1" in poses["scale"]


def test_cloud_lies_on_the_walls(quickstart: tuple[Path, str]) -> None:
    cloud = read_ply(quickstart[0] / "cloud.ply")
    assert len(cloud) > 5000
    lengths = np.linalg.norm(cloud.normals_in_world, axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-3)
    # The first camera is at the origin of the level world of the run, whose unit is the first baseline.
    true_poses = capture_poses(4, spread=0.4)
    true_centers = np.array([true_poses[0].apply(pose.center) for pose in true_poses])
    centers = np.array(run_json(quickstart[0])["poses"]["centers"])
    scale = np.linalg.norm(true_centers[1:], axis=1).sum() / np.linalg.norm(centers[1:] - centers[0], axis=1).sum()
    points = scale * cloud.points_in_world.astype(np.float64)
    distances = np.linalg.norm(points, axis=1)
    in_first = points @ read_poses(quickstart[0] / "colmap/sparse/0").rotations[0].T
    in_room = true_poses[0].inverse().apply(in_first) - true_poses[0].center
    true = range_along(default_room(), true_poses[0].center, in_room / distances[:, None])
    visible = true > 0.9 * distances  # from the first camera
    assert visible.mean() > 0.9
    error = np.abs(true / distances - 1)[visible]
    assert np.median(error) < 0.015
    assert (error < 0.05).mean() > 0.9


@pytest.mark.slow
def test_a_second_run_computes_nothing_and_one_after_a_touch_what_depends_on_it(
    pano_mvs: Command, capture: Path
) -> None:
    arguments = ("known_poses", *known(capture), *FEW_RANGES)
    assert pano_mvs("run", *arguments).code == 0
    assert pose_errors(Path("out/known_poses"), capture / "truth").median_pair_deg < 1e-6, "known poses do not move"
    second = pano_mvs("run", *arguments)
    assert "0 units computed" in second.text
    assert "(nothing to compute)" in second.text
    path = capture / "images" / "003.png"
    image = read_picture(path)
    image[0, 0] ^= 1
    cv2.imwrite(str(path), image)
    plan = pano_mvs("plan", *arguments)
    assert "images:003.png: input 003.png" in plan.text
    result = pano_mvs("run", *arguments)
    assert result.code == 0
    stages = {stage["name"]: stage["run"] for stage in run_json(Path("out/known_poses"))["stages"]}
    assert stages["images"] == 1
    assert stages["features"] == 1
    assert stages["matches"] <= 3
    assert stages["pairs"] == 1, "it compares the global descriptors of all images"
    assert stages["poses"] == 1, "it looks whether the pictures are those whose poses the file records"


@pytest.mark.slow
def test_pictures_without_overlap_end_with_the_reasons(pano_mvs: Command, capture: Path) -> None:
    rng = np.random.default_rng(0)
    for path in sorted((capture / "images").iterdir()):
        noise = rng.integers(0, 255, (SIZE_HW[0] // 8, SIZE_HW[1] // 8, 3), dtype=np.uint8)
        cv2.imwrite(str(path), cv2.resize(noise, SIZE_HW[::-1], interpolation=cv2.INTER_CUBIC))
    by_sift = ("--set", "weak.learned=never")  # the networks take long to find nothing
    result = pano_mvs("run", "quickstart", "--images", capture / "images", "--out", "out", *SMALL, *by_sift)
    assert result.code == 4
    assert "no two panoramas could be registered" in result.flat
    assert not Path("out/cloud.ply").exists()
    assert Path("out/report.html").exists()


def test_status_tells_what_happened(pano_mvs: Command, rendered: Path) -> None:
    before = pano_mvs("status", "quickstart", "--images", rendered / "images", "--out", "o")
    assert "no finished run in o" in before.text
    assert before.code == 0


@pytest.mark.slow
def test_fast_runs_from_pictures_to_cloud(pano_mvs: Command, rendered: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = pano_mvs(
        *f"run fast --images {rendered / 'images'} --out {out} --set scores.truth={rendered / 'truth'}".split(),
        *["--set", "features.max_keypoints=1500"],
    )
    assert result.code == 0, result.text
    assert {stage["name"]: stage["run"] for stage in run_json(out)["stages"]}["depth"] == 4
    ranges = [read_range_tiff(out / f"range/00{view}.tiff") for view in range(4)]
    assert all(np.isfinite(found).mean() > 0.8 for found in ranges)
    assert len(read_ply(out / "cloud.ply")) > 5000


def test_exchanged_ranges_are_checked_against_those_before_the_exchange() -> None:
    """Otherwise the view that a range comes from confirms it."""
    edges = open_session("quality").graph.edges["checked"]
    assert edges["range_map"].producer == "exchanged"
    assert edges["sources"].producer == "plain"


@pytest.mark.slow
def test_mesh_is_of_ranges_that_are_more_precise_than_those_of_the_quickstart(
    pano_mvs: Command, rendered: Path, quickstart: tuple[Path, str], tmp_path: Path
) -> None:
    """The room is 6 × 2.8 × 5 units of the truth, and the mesh is in units of the first baseline."""
    out, cache = tmp_path / "mesh", shutil.copytree(quickstart[0].parent / "cache", tmp_path / "cache")
    settings = (
        *("textured.triangles=5000", "textured.texture_px=512", f"scores.truth={rendered / 'truth'}"),
        *("views.sources=3", "scene_planes.min_share=0.05", "floor_plan=null"),  # tests of the plugin draw plans
    )
    arguments = (
        *("mesh", "--images", rendered / "images", "--out", out, "--cache", cache, *SMALL),
        *(part for setting in settings for part in ("--set", setting)),
    )
    result = pano_mvs("run", *arguments)
    assert result.code == 0, result.text
    errors = []
    for folder in (quickstart[0], out):
        views = range_errors(folder, rendered / "truth").values()
        errors.append(np.mean([view.median for view in views]))
        assert all(np.isfinite(read_range_tiff(folder / f"range/00{view}.tiff")).mean() > 0.95 for view in range(4))
    assert errors[1] < 0.6 * errors[0]
    assert len(read_ply(out / "cloud.ply")) > 5000
    read = trimesh.load(out / "mesh_textured.glb", force="mesh")
    assert isinstance(read, trimesh.Trimesh)
    assert 500 < len(read.faces) <= 1.25 * 5000  # simplified to about as many
    extent = read.vertices.max(axis=0) - read.vertices.min(axis=0)
    assert int(np.argmin(extent)) == 1  # y is up, and rooms are wider than high
    metrics = next(stage["metrics"] for stage in run_json(out)["stages"] if stage["name"] == "textured")
    assert metrics["seen"] > 0.3
    assert read_picture(out / "mesh_textured_seen.png").any()
    for name in ("mesh_textured.obj", "mesh_textured.mtl", "mesh_textured.jpg"):
        assert (out / name).is_file()
    again = pano_mvs("run", *arguments)
    assert "0 units computed" in again.flat


@pytest.mark.slow
def test_colmap_dense_writes_models_masks_and_a_workspace_that_fuses(
    pano_mvs: Command, rendered: Path, quickstart: tuple[Path, str]
) -> None:
    out, cache = Path("out"), shutil.copytree(quickstart[0].parent / "cache", "cache")
    arguments = (
        *f"run colmap_dense --images {rendered / 'images'} --out {out} --cache {cache}".split(),
        *SMALL,
        *[word for name in ("scores", "previews", "cloud", "ply", "smooth") for word in ("--set", f"{name}=null")],
        *["--set", "views.sources=2", "--set", "tracked.count=2000"],
    )
    result = pano_mvs(*arguments)
    assert result.code == 0, result.text
    sparse = pycolmap.Reconstruction(out / "colmap/sparse/0")
    seeds = pycolmap.Reconstruction(out / "colmap_dense_init/sparse/0")
    faces = pycolmap.Reconstruction(out / "colmap_dense/sparse")
    assert (out / "colmap/sparse/0/images.txt").is_file()
    assert sorted(image.name for image in sparse.images.values()) == [f"{name}.png" for name in NAMES]
    assert seeds.num_points3D() == sparse.num_points3D() + 2000
    assert (faces.num_reg_images(), faces.num_rigs(), faces.num_frames()) == (24, 1, 4)
    assert faces.num_points3D() == seeds.num_points3D()
    for name in NAMES:
        assert read_picture(out / f"colmap/masks/{name}.png.png", cv2.IMREAD_UNCHANGED).shape == SIZE_HW
    assert len(fused_points(out / "colmap_dense")) > 3000
    metrics = {stage["name"]: stage["metrics"] for stage in run_json(out)["stages"]}
    assert metrics["dense"]["faces_without_points"] == 0
    again = pano_mvs(*arguments)
    assert "0 units computed" in again.text


def command(folder: Path, *options: str) -> list[str]:
    return [
        sys.executable,
        *f"-m pano_mvs run quickstart --out {folder / 'out'} --cache {folder / 'cache'}".split(),
        *options,
    ]


@pytest.mark.slow
def test_poses_and_ranges_are_as_good_as_promised(sample: Path) -> None:
    truth = presets_folder() / "samples/classroom/truth"
    poses = pose_errors(sample / "out", truth)
    assert poses.registered == 4
    assert poses.median_pair_deg <= 0.15
    assert poses.scale_ratio_max <= 0.02
    first = range_errors(sample / "out", truth)["000"]
    assert first.psnr_db >= 28
    assert first.near >= 0.65
    assert first.completeness >= 0.99, "slats of the blinds are part of the sky behind them, and frames at its edge"


def kill_in(stage: str, folder: Path, *options: str) -> None:
    """Run until the first unit of a stage is computed, and kill the run while the others are in work."""
    line = [*command(folder, *options), "--json"]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    events = (json.loads(line) for line in process.stdout)
    assert any((event["event"], event.get("stage")) == ("unit_finished", stage) for event in events)
    process.kill()
    process.communicate()


def times_of_records(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in (folder / "cache" / "records").rglob("*.json")}


def units_of(folder: Path) -> dict[str, int]:
    """Return how many units the latest run computed, and how many it had; records may be in packs then."""
    return dict(json.loads((folder / "out" / "run.json").read_text())["units"])


@pytest.mark.slow
def test_killed_in_the_middle_it_resumes_to_the_same_bytes(
    tmp_path: Path, rendered: Path, quickstart: tuple[Path, str]
) -> None:
    """The run is killed twice: while it matches, and in the middle of the sweep."""
    options = ("--images", str(rendered / "images"), "--set", f"scores.truth={rendered / 'truth'}", *SMALL)
    undisturbed = quickstart[0].parent
    whole = units_of(undisturbed)
    kill_in("matches", tmp_path, *options)
    matched = times_of_records(tmp_path)
    kill_in("depth", tmp_path, *options)
    swept = times_of_records(tmp_path)
    assert 0 < len(matched) < len(swept) < whole["run"]
    assert matched.items() <= swept.items()  # what was computed is not computed again
    assert subprocess.run(command(tmp_path, *options), check=False).returncode == 0
    resumed = units_of(tmp_path)
    assert resumed["run"] + len(swept) == whole["run"]
    assert resumed["run"] + resumed["cached"] == whole["run"] + whole["cached"]
    assert deliverables(tmp_path / "out") == deliverables(undisturbed / "out")
