"""The shipped workflows on a tiny capture, and the contracts of their output."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.testing.room import capture_poses, default_room, range_along
from tests.cli.conftest import SIZE_HW, SMALL, Command, deliverables, run_json
from tests.stored import read_picture


def known(capture: Path) -> tuple[str, ...]:
    """Options that point known_poses at a rendered capture and its truth."""
    truth = capture / "truth"
    paths = ("--set", f"poses.path={truth / 'poses.json'}", "--set", f"scores.truth={truth}")
    return ("--images", str(capture / "images"), *paths, *SMALL)


NAMES = ["000", "001", "002", "003"]


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
        "logs/events.jsonl",
        ".pano-mvs-output",
    }


def test_quickstart_tells_the_accuracy_and_where_the_results_are(quickstart: tuple[Path, str]) -> None:
    out, text = quickstart
    assert "against the ground truth" in text
    assert "PSNR" in text
    assert str(out) in "".join(text.split())


def test_quickstart_recovers_poses_and_ranges(quickstart: tuple[Path, str]) -> None:
    scores = run_json(quickstart[0])["scores"]
    assert scores["poses"]["registered"] == 4
    assert scores["poses"]["median_pair_error_deg"] < 0.3
    assert scores["poses"]["scale_ratio_error_max"] < 0.03
    for view in scores["views"].values():
        assert view["psnr_db"] > view["constant_psnr_db"] + 6
        assert view["w_delta_105"] > 0.6
        assert view["completeness"] > 0.95


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
def test_second_run_computes_nothing_and_separate_stores_agree(pano_mvs: Command, capture: Path) -> None:
    arguments = ("run", "known_poses", *known(capture))
    first = pano_mvs(*arguments, "--out", "a", "--cache", "cache_a")
    assert first.code == 0, first.text
    second = pano_mvs(*arguments, "--out", "a", "--cache", "cache_a")
    assert "0 units computed" in second.text
    assert "(nothing to compute)" in second.text
    other = pano_mvs(*arguments, "--out", "b", "--cache", "cache_b")
    assert other.code == 0
    assert deliverables(Path("a")) == deliverables(Path("b"))
    scores = run_json(Path("a"))["scores"]["poses"]
    assert scores["median_pair_error_deg"] < 1e-6, "known poses do not move"


@pytest.mark.slow
def test_touching_one_image_under_known_poses_runs_exactly_its_units(pano_mvs: Command, capture: Path) -> None:
    limits = ("--set", "views.sources=2", "--set", "depth.near=0.4", "--set", "depth.far=6")
    arguments = ("known_poses", *known(capture), *limits)
    assert pano_mvs("run", *arguments).code == 0
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


def test_evaluate_compares_an_output_folder_with_the_truth(
    quickstart: tuple[Path, str], rendered: Path, pano_mvs: Command
) -> None:
    result = pano_mvs("evaluate", quickstart[0], "--truth", rendered / "truth")
    assert result.code == 0, result.text
    psnr = run_json(quickstart[0])["scores"]["views"]["000.png"]["psnr_db"]
    assert f"{psnr:.2f}" in result.text
    nothing = pano_mvs("evaluate", rendered, "--truth", rendered / "truth")
    assert nothing.code == 2
    assert "Give the output folder of a finished run" in nothing.flat


@pytest.mark.slow
def test_an_output_folder_beside_the_pictures_is_not_taken_for_pictures(pano_mvs: Command, capture: Path) -> None:
    """`--images .` with `out/` below it once swept up its own previews."""
    shutil.copytree(capture / "images", Path.cwd(), dirs_exist_ok=True)
    arguments = ("run", "quickstart", "--images", ".", *SMALL, "--set", f"scores.truth={capture / 'truth'}")
    assert pano_mvs(*arguments).code == 0
    again = pano_mvs(*arguments)
    assert "0 units computed" in again.text
