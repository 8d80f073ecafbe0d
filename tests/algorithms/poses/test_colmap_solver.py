"""COLMAP's mappers on our key points and matches: the poses of synthetic captures, and what is said of failures."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from pano_mvs.algorithms.faces.layout import CUBE_ROTATIONS
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.colmap import solver as colmap
from pano_mvs.algorithms.poses.colmap.database import Cameras, face_of_bearing, face_pixels, face_size, write_database
from pano_mvs.algorithms.poses.colmap.mapping import Mapper
from pano_mvs.algorithms.poses.colmap.sift import colmap_sift
from pano_mvs.algorithms.poses.colmap.solver import solve_colmap
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle
from pano_mvs.geometry.pose_errors import relative_pose_errors
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.algorithms.poses.synthetic_capture import random_poses, synthetic_features, synthetic_two_views
from tests.scene.pose_groups import drawn_group

Capture = tuple[dict[str, Rigid3], dict[str, Features], dict[tuple[str, str], TwoView]]
First = Callable[[Mapper, Cameras], Poses]
MAPPERS: list[tuple[Mapper, Cameras]] = [
    ("incremental", "sphere"),
    ("incremental", "faces"),
    ("global", "sphere"),
    ("global", "faces"),
]


def made(seed: int, count: int = 6, noise_deg: float = 0.05) -> Capture:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, count)
    features = synthetic_features(rng, truth, points=600, noise_deg=noise_deg)
    return truth, features, synthetic_two_views(rng, features)


@pytest.fixture(scope="module")
def capture() -> Capture:
    """Six cameras turned at random, a third of their matches wrong before verification."""
    return made(3)


def solved(capture: Capture, folder: Path, mapper: Mapper = "incremental", cameras: Cameras = "sphere") -> Poses:
    _, features, two_views = capture
    poses = solve_colmap(
        features, two_views, mapper=mapper, cameras=cameras, rng=np.random.default_rng(7), scratch=folder
    )
    poses.check()
    return poses


@pytest.fixture(scope="module")
def first_solved(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> First:
    """The poses of the capture by each mapper, which is called once; not to be changed."""
    return cache(lambda mapper, cameras: solved(capture, tmp_path_factory.mktemp("solved"), mapper, cameras))


def by_name(poses: Poses) -> dict[str, Rigid3]:
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}


@pytest.mark.slow
@pytest.mark.parametrize(("mapper", "cameras"), MAPPERS)
def test_poses_are_recovered(capture: Capture, first_solved: First, mapper: Mapper, cameras: Cameras) -> None:
    poses = first_solved(mapper, cameras)
    errors = relative_pose_errors(by_name(poses), capture[0])
    assert errors.registered == 6
    assert poses.rejected == {}
    assert errors.median_pair_deg < 0.05
    assert errors.scale_ratio_max < 0.01
    refined = relative_pose_errors(by_name(refine_poses(poses)), capture[0])
    assert refined.median_pair_deg < 0.04


@pytest.mark.slow
@pytest.mark.parametrize(("mapper", "cameras"), [("global", "sphere"), ("incremental", "faces")])
def test_the_same_input_gives_the_same_digits(
    capture: Capture, first_solved: First, tmp_path: Path, mapper: Mapper, cameras: Cameras
) -> None:
    first, second = first_solved(mapper, cameras), solved(capture, tmp_path, mapper, cameras)
    assert first is not second
    for field in ("rotations", "translations", "points_in_world", "track_bearings", "track_point_idx"):
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))


@pytest.mark.parametrize("cameras", ["sphere", "faces"])
def test_tracks_are_our_key_points(capture: Capture, first_solved: First, cameras: Cameras) -> None:
    """Bearings come back exactly, fit their points, and no image sees a point twice."""
    poses = first_solved("incremental", cameras)
    _, features, _ = capture
    for idx, name in enumerate(poses.names):
        rays = {ray.tobytes() for ray in features[name].bearings}
        assert all(ray.tobytes() in rays for ray in poses.track_bearings[poses.track_image_idx == idx])
    towards = poses.points_in_world[poses.track_point_idx] - poses.centers[poses.track_image_idx]
    in_cam = np.einsum("tij,tj->ti", poses.rotations[poses.track_image_idx], towards)
    errors = angle_between(in_cam, poses.track_bearings)
    assert np.rad2deg(np.median(errors)) < 0.1
    means = np.bincount(poses.track_point_idx, errors) / np.bincount(poses.track_point_idx)
    assert poses.point_errors_rad == pytest.approx(means, rel=1e-4)
    pairs = np.stack([poses.track_point_idx, poses.track_image_idx], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert len(poses.points_in_world) > 300
    assert (poses.point_colors_rgb == 128).all()


def test_world_is_the_first_camera_and_its_first_baseline(first_solved: First) -> None:
    poses = first_solved("incremental", "sphere")
    np.testing.assert_array_equal(poses.rotations[0], np.eye(3))
    np.testing.assert_array_equal(poses.translations[0], 0)
    assert np.linalg.norm(poses.centers[1]) == pytest.approx(1)


def test_two_places_make_two_groups_each_in_its_own_world(tmp_path: Path) -> None:
    truth, features, two_views = made(4, count=5)
    other_truth, others, other_views = made(5, count=3)
    features |= {f"other {name}": found for name, found in others.items()}
    two_views |= {(f"other {a}", f"other {b}"): view for (a, b), view in other_views.items()}
    poses = solve_colmap(features, two_views, rng=np.random.default_rng(0), scratch=tmp_path)
    poses.check()
    assert poses.rejected == {}
    assert poses.names == tuple(features)
    assert poses.groups.tolist() == [0] * 5 + [1] * 3
    large, small = split_groups(poses)
    assert relative_pose_errors(by_name(large), truth).pair_deg.max() < 0.5
    assert (
        relative_pose_errors({name[6:]: pose for name, pose in by_name(small).items()}, other_truth).pair_deg.max()
        < 0.5
    )
    for group in (large, small):
        np.testing.assert_array_equal(group.rotations[0], np.eye(3))
        assert np.linalg.norm(group.centers[1]) == pytest.approx(1)


def test_a_panorama_in_two_models_is_taken_from_the_larger_one(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP's sub-models may overlap; what is left of the third one here is a single panorama."""
    models = [
        drawn_group(("0.jpg", "1.jpg", "2.jpg"), seed=1),
        drawn_group(("2.jpg", "3.jpg", "4.jpg"), seed=2),
        drawn_group(("4.jpg", "5.jpg"), seed=3),
    ]
    monkeypatch.setattr(colmap, "run_mapper", lambda *_, **__: models)
    monkeypatch.setattr(colmap, "poses_from_model", lambda model, *_, **__: model)
    poses = solved(capture, tmp_path)
    assert poses.names == ("0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg")
    assert poses.groups.tolist() == [0, 0, 0, 1, 1]
    assert len(poses.points_in_world) == sum(len(model.points_in_world) for model in models[:2])
    assert list(poses.rejected) == ["5.jpg"]
    assert "COLMAP did not register it" in poses.rejected["5.jpg"]


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_without_any_sound_pair_all_are_rejected(capture: Capture, tmp_path: Path, mapper: Mapper) -> None:
    truth, features, two_views = capture
    nothing = {pair: TwoView.failed("too dark", candidates=3) for pair in two_views}
    poses = solved((truth, features, nothing), tmp_path, mapper)
    assert poses.names == ()
    assert list(poses.rejected) == list(features)
    assert all("COLMAP" in reason for reason in poses.rejected.values())


def test_a_picture_without_pairs_is_told_why(capture: Capture, tmp_path: Path) -> None:
    truth, features, two_views = capture
    lonely = {
        pair: TwoView.failed("a blurred picture", candidates=9) if "4.jpg" in pair else view
        for pair, view in two_views.items()
    }
    poses = solved((truth, features, lonely), tmp_path)
    assert list(poses.rejected) == ["4.jpg"]
    assert "a blurred picture" in poses.rejected["4.jpg"]


def test_faces_are_rotations_that_cover_the_sphere_and_agree_with_colmaps_pinhole() -> None:
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(500, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    faces = face_of_bearing(rays)
    assert set(faces) == set(range(6))
    size = face_size((512, 1024))
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=size, height=size, params=[size / 2, size / 2, size / 2])
    for idx, rotation in enumerate(CUBE_ROTATIONS):
        assert np.linalg.det(rotation) == pytest.approx(1)
        inside = rays[faces == idx]
        pixels = face_pixels(inside, idx, size)
        assert pixels.min() >= 0
        assert pixels.max() <= size
        np.testing.assert_allclose(camera.img_from_cam(inside @ rotation.T), pixels, atol=1e-9)


@pytest.mark.parametrize(("cameras", "per_panorama"), [("sphere", 1), ("faces", 6)])
def test_database_holds_all_matches_and_their_geometry(
    capture: Capture, tmp_path: Path, cameras: Cameras, per_panorama: int
) -> None:
    truth, features, two_views = capture
    images = write_database(tmp_path / "d.db", features, two_views, cameras=cameras)
    assert len(images) == per_panorama * len(features)
    database = pycolmap.Database.open(tmp_path / "d.db")
    assert database.num_frames() == len(features)
    assert database.num_rigs() == 1
    assert database.num_keypoints() == sum(len(found) for found in features.values())
    pair_ids, geometries = database.read_two_view_geometries()
    assert sum(len(geometry.inlier_matches) for geometry in geometries) == sum(len(v) for v in two_views.values())
    names = list(features)
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        a, b = (images[idx] for idx in pycolmap.pair_id_to_image_pair(pair_id))
        true = truth[names[b.panorama_idx]] @ truth[names[a.panorama_idx]].inverse()
        expected = b.face_from_panorama @ true.rotation @ a.face_from_panorama.T
        assert np.rad2deg(geodesic_angle(geometry.cam2_from_cam1.rotation.matrix(), expected)) < 0.5
    database.close()


@pytest.fixture(scope="module")
def pictures() -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Three rendered panoramas, the lower left of each masked."""
    valid = np.ones((240, 480), np.bool_)
    valid[120:, :200] = False
    poses = capture_poses(3, spread=0.4)
    return [
        (f"b/{n} ä.png", render(default_room(), pose, (240, 480), supersample=1)[0], valid)
        for n, pose in enumerate(poses)
    ]


@pytest.mark.slow
def test_colmaps_sift_respects_masks_and_registers(
    pictures: list[tuple[str, np.ndarray, np.ndarray]], tmp_path: Path
) -> None:
    features, two_views = colmap_sift(pictures, rng=np.random.default_rng(0), scratch=tmp_path)
    assert list(features) == [name for name, _, _ in pictures]
    for found in features.values():
        found.check()
        azimuth = np.arctan2(found.bearings[:, 0], found.bearings[:, 2])
        assert not ((found.bearings[:, 1] > 0.02) & (azimuth < 2 * np.pi * (200 / 480 - 0.5) - 0.02)).any()
        assert len(found) > 100
    poses = solve_colmap(features, two_views, rng=np.random.default_rng(0), scratch=tmp_path)
    truth = dict(zip(features, capture_poses(3, spread=0.4), strict=True))
    assert relative_pose_errors(by_name(poses), truth).median_pair_deg < 1


@pytest.mark.slow
def test_the_terminal_stays_quiet_and_the_log_level_is_restored(tmp_path: Path) -> None:
    code = (
        "import numpy as np, sys; from pathlib import Path; from tests.algorithms.poses.test_colmap_solver import *; "
        "before = pycolmap.logging.minloglevel; solved(made(3, 3), Path(sys.argv[1])); "
        "assert pycolmap.logging.minloglevel == before"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], check=True, capture_output=True, text=True, env=environment
    )
    assert result.stderr == result.stdout == ""
