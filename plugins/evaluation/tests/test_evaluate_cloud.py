"""`evaluate cloud` against true range maps and against reference clouds, in whatever frame the cloud is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from pano_mvs_evaluation.clouds.evaluate import evaluate_cloud
from pano_mvs_evaluation.clouds.true_surface import TrueView, view_points
from test_evaluate_poses import write_json

from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec
from pano_mvs.io.ply import open_ply_points, write_ply
from pano_mvs.io.truth import read_truth
from pano_mvs.scene import PointCloud
from tests.algorithms.poses.synthetic_capture import random_rotation
from tests.cli.conftest import Command
from tests.stored import read_picture
from tests.synthetic.exported_clouds import exported, the_cloud, the_poses


def save(path: Path, points: np.ndarray, normal: ArrayLike = (0, -1, 0)) -> Path:
    count = len(points)
    up = np.tile(np.array(normal, np.float32), (count, 1))
    grey = np.full((count, 3), 99, np.uint8)
    write_ply(path, PointCloud(points.astype(np.float32), up, grey, np.ones(count, np.uint8)))
    return path


@pytest.fixture(scope="module")
def folder(rendered: Path) -> Path:
    return next(path.parent for path in rendered.rglob("poses.json"))


@pytest.fixture(scope="module")
def surface(folder: Path) -> np.ndarray:
    """The true surface of all views."""
    truth = read_truth(folder)
    return np.concatenate(
        [
            view_points(TrueView(view.cam_from_world, ranges))
            for view in truth.views.values()
            if (ranges := truth.range_map(view)) is not None
        ]
    )


@pytest.mark.slow
def test_the_truth_is_perfect_in_its_own_frame_and_in_any_other(
    pano_mvs: Command, tmp_path: Path, folder: Path, surface: np.ndarray
) -> None:
    plain = pano_mvs("evaluate", "cloud", save(tmp_path / "a.ply", surface), "--truth", folder, "--json")
    assert plain.code == 0, plain.text
    told = json.loads(plain.text)
    assert [score["threshold"] for score in told["scores"]] == [0.05, 0.02]
    assert [score["accuracy"] for score in told["scores"]] == [1, 1]
    assert told["scores"][0]["completeness"] > 0.9
    assert (told["views_with_truth"], len(told["cameras"]), told["points"]) == (4, 4, len(surface))
    moved = Similarity3(0.3, random_rotation(np.random.default_rng(1)), np.array([1.0, 2, 3]))
    poses = {name: moved.move_camera(pose) for name, pose in read_truth(folder).poses.items()}
    arguments = (save(tmp_path / "b.ply", moved.apply(surface)), "--poses", write_json(tmp_path / "m.json", poses))
    other = json.loads(pano_mvs("evaluate", "cloud", *arguments, "--truth", folder, "--json").text)
    for ours, theirs in zip(other["scores"], told["scores"], strict=True):
        assert ours == pytest.approx(theirs, abs=2e-3)
    # A reference cloud knows no cameras; with true poses the frame is found all the same.
    reference = ("--truth", tmp_path / "a.ply", "--true-poses", folder / "poses.json")
    against = json.loads(pano_mvs("evaluate", "cloud", *arguments, *reference, "--json").text)
    assert [score["f_score"] for score in against["scores"]] == pytest.approx([1, 1], abs=1e-3)
    failed = pano_mvs("evaluate", "cloud", *arguments, "--truth", tmp_path / "a.ply")
    assert failed.code == 2
    assert "give the true poses" in failed.flat


@pytest.mark.slow
def test_truth_may_be_range_maps_in_files_beside_the_poses(
    pano_mvs: Command, tmp_path: Path, folder: Path, surface: np.ndarray
) -> None:
    truth = tmp_path / "truth"
    (truth / "range").mkdir(parents=True)
    shutil.copy(folder / "poses.json", truth)
    with np.load(folder / "depth.npz") as arrays:
        for key in arrays:
            np.save(truth / "range" / f"{key}.npy", arrays[key])
    cloud = save(tmp_path / "a.ply", surface[::7])
    found, wanted = (
        json.loads(pano_mvs("evaluate", "cloud", cloud, "--truth", path, "--json").text) for path in (truth, folder)
    )
    assert found.pop("truth") != wanted.pop("truth")
    assert found == wanted


@pytest.mark.slow
def test_only_what_the_cameras_used_see_must_be_found(
    pano_mvs: Command, tmp_path: Path, folder: Path, surface: np.ndarray
) -> None:
    two = dict(list(read_truth(folder).poses.items())[:2])
    half = surface[surface[:, 0] > 0]
    arguments = ("--poses", write_json(tmp_path / "two.json", two), "--truth", folder, "--threshold", "0.1")
    text = pano_mvs("evaluate", "cloud", save(tmp_path / "a.ply", half), *arguments).flat
    assert f"{len(half)} points against the surface that 4 views see" in text
    assert "at least 2 of 2 cameras see" in text
    (score,) = json.loads(pano_mvs("evaluate", "cloud", tmp_path / "a.ply", *arguments, "--json").text)["scores"]
    assert 0.3 < score["completeness"] < 0.7
    assert score["accuracy"] == 1


@pytest.mark.slow
def test_the_picture_shows_each_view_and_the_cloud(
    pano_mvs: Command, tmp_path: Path, folder: Path, surface: np.ndarray
) -> None:
    off = np.where(surface[:, :1] > 0, surface, surface * 1.2)
    arguments = (save(tmp_path / "a.ply", off), "--truth", folder, "--picture", tmp_path / "new" / "a.png")
    assert pano_mvs("evaluate", "cloud", *arguments).code == 0
    picture = read_picture(tmp_path / "new" / "a.png")
    assert picture is not None
    height, width = picture.shape[:2]
    assert (width, height > 4 * 512) == (1024, True)
    red = (picture == (45, 30, 190)).all(axis=-1)
    assert 0.1 < red[28 : 4 * 512].mean() < 0.9


def test_a_cloud_against_itself_is_perfect_and_no_distance_from_it(
    pano_mvs: Command, tmp_path: Path, surface: np.ndarray
) -> None:
    own = save(tmp_path / "a.ply", surface)
    told = json.loads(pano_mvs("evaluate", "cloud", own, "--truth", own, "--threshold", "1e-6", "--json").text)
    assert told["scores"] == [{"threshold": 1e-6, "accuracy": 1, "completeness": 1, "f_score": 1}]
    assert told["distances"]["accuracy"] == told["distances"]["completeness"] == {"median": 0, "p90": 0}
    away = save(tmp_path / "b.ply", surface + 100)
    text = pano_mvs("evaluate", "cloud", away, "--truth", own, "--threshold", "0.5").flat
    assert "points from the surface: median over 10, 90 % within over 10" in text


def test_the_cloud_of_a_run_lies_in_the_frame_of_a_reference_without_poses(
    pano_mvs: Command, tmp_path: Path, surface: np.ndarray
) -> None:
    own = save(tmp_path / "cloud.ply", surface[::50])
    model = tmp_path / "colmap/sparse/0"
    model.mkdir(parents=True)
    plain = pano_mvs("evaluate", "cloud", tmp_path, "--truth", own)
    assert plain.code == 0, plain.text
    assert "both clouds are assumed to be in the same frame" in plain.flat
    assert "100.00" in plain.text
    named = pano_mvs("evaluate", "cloud", tmp_path, "--truth", own, "--poses", model)
    assert (named.code, "give the true poses" in named.flat) == (2, True)


@pytest.mark.slow
def test_up_is_where_the_cameras_have_it(tmp_path: Path, folder: Path, surface: np.ndarray) -> None:
    reference = save(tmp_path / "a.ply", surface)
    turned = Similarity3(1.0, rotation_from_rotvec([0.9, 0.4, -0.2]), np.zeros(3))
    poses = read_truth(folder).poses
    for place, expected in (
        (Similarity3(1.0, np.eye(3), np.zeros(3)), (0, -1, 0)),
        (turned, turned.rotation @ (0, -1, 0)),
    ):
        known = write_json(tmp_path / "m.json", {name: place.move_camera(pose) for name, pose in poses.items()})
        found = evaluate_cloud(reference, reference, true_poses=known, poses=known).compared.up
        angle_deg = np.rad2deg(np.arccos(found @ expected))
        assert angle_deg < 10  # the cameras of the room are held nearly level
    flips = (np.eye(3), np.diag([1.0, -1, -1])) * 2
    upside = {name: Rigid3(flip, pose.translation) for flip, (name, pose) in zip(flips, poses.items(), strict=True)}
    known = write_json(tmp_path / "m.json", upside)
    found = evaluate_cloud(reference, reference, true_poses=known, poses=known).compared.up
    np.testing.assert_array_equal(found, [0, -1, 0])


@pytest.mark.slow
def test_errors_are_written_as_clouds_and_drawn(
    pano_mvs: Command, tmp_path: Path, folder: Path, surface: np.ndarray
) -> None:
    """Half of the cloud lies 0.2 off: those points, and that half of the surface, are red in files and pictures."""
    half = surface[:, 0] > 0
    points = np.where(half[:, None], surface * 1.2, surface)
    moved = Similarity3(0.5, rotation_from_rotvec([np.pi / 2, 0, 0]), np.array([3.0, 0, 1]))
    poses = {name: moved.move_camera(pose) for name, pose in read_truth(folder).poses.items()}
    model = write_json(tmp_path / "m.json", poses)
    cloud = save(tmp_path / "a.ply", moved.apply(points), moved.rotation @ (0, -1, 0))
    arguments = ("--poses", model, "--truth", folder, "--out", tmp_path / "e", "--json")
    told = json.loads(pano_mvs("evaluate", "cloud", cloud, *arguments).text)
    files = ["accuracy.ply", "accuracy.png", "completeness.ply", "completeness.png", "errors.png"]
    assert sorted(path.name for path in (tmp_path / "e").iterdir()) == files
    accuracy = open_ply_points(tmp_path / "e" / "accuracy.ply")
    np.testing.assert_allclose(np.concatenate(list(accuracy.chunks())), points, atol=1e-4)  # in the truth's frame
    within = accuracy.vertices["distance"] <= 0.05
    assert within.mean() == pytest.approx(told["scores"][0]["accuracy"], abs=1e-9)
    assert within[~half].all()
    np.testing.assert_array_equal(accuracy.vertices["red"] == 190, ~within)
    missed = open_ply_points(tmp_path / "e" / "completeness.ply").vertices
    assert missed["distance"][missed["x"] > 0.5].mean() > 5 * missed["distance"][missed["x"] < -0.5].mean()
    for name in ("accuracy.png", "completeness.png"):
        picture = read_picture(tmp_path / "e" / name)
        assert picture is not None
        assert picture.shape == (3 * (640 + 40) + 60, 1024, 3)
        above = picture[60 : 60 + 640]
        red, right = ((np.abs(above.astype(int) - color).max(axis=-1) < 3) for color in ((45, 30, 190), (142, 130, 38)))
        assert min(red.mean(), right.mean()) > 0.01
        assert np.nonzero(red)[1].mean() > np.nonzero(right)[1].mean()  # x grows to the right


def test_what_cannot_be_compared_is_named(pano_mvs: Command, tmp_path: Path, folder: Path) -> None:
    cloud = save(tmp_path / "a.ply", np.zeros((1, 3)))
    none = pano_mvs("evaluate", "cloud", cloud, "--truth", folder, "--threshold", "0")
    assert (none.code, "tolerances must be positive" in none.flat) == (2, True)
    strange = write_json(tmp_path / "s.json", {"else.jpg": Rigid3.identity()})
    lost = pano_mvs("evaluate", "cloud", cloud, "--truth", folder, "--poses", strange)
    assert (lost.code, "cannot be brought into the frame of the truth" in lost.flat) == (2, True)
    gone = pano_mvs("evaluate", "cloud", tmp_path / "no.ply", "--truth", folder)
    assert (gone.code, "no.ply: cannot be read" in gone.flat) == (2, True)


def test_scores_of_a_cloud_do_not_depend_on_the_frame_of_the_file(tmp_path: Path) -> None:
    upright = evaluate_cloud(exported(tmp_path, the_poses()), the_cloud().points_in_world)
    assert upright.scores[0].f_score == 1
