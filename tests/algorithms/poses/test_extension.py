"""New pictures against known cameras: those stay to the last digit, the new ones are found or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.algorithms.poses.colmap.database import Cameras
from pano_mvs.algorithms.poses.colmap.solver import extend_with_colmap
from pano_mvs.algorithms.poses.extension import extend_poses
from pano_mvs.geometry import Rigid3
from pano_mvs.geometry.pose_errors import relative_pose_errors
from pano_mvs.scene import Features, Poses, TwoView
from tests.algorithms.poses.synthetic_capture import random_poses, synthetic_features, synthetic_two_views

Capture = tuple[dict[str, Rigid3], dict[str, Features], dict[tuple[str, str], TwoView]]


@pytest.fixture(scope="module")
def capture() -> Capture:
    rng = np.random.default_rng(11)
    truth = random_poses(rng, 6)
    features = synthetic_features(rng, truth, points=600, noise_deg=0.03)
    return truth, features, synthetic_two_views(rng, features)


def known_of(truth: dict[str, Rigid3], names: list[str]) -> Poses:
    return Poses.without_points({name: truth[name] for name in names}, frame="the file's", scale="metres", metric=True)


def found_by_name(poses: Poses) -> dict[str, Rigid3]:
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}


@pytest.mark.parametrize("new", ["0.jpg", "3.jpg", "5.jpg"])
def test_the_sixth_is_found_and_five_do_not_move(capture: Capture, new: str) -> None:
    truth, features, two_views = capture
    known = known_of(truth, [name for name in truth if name != new])
    poses = extend_poses(known, features, two_views)
    poses.check()
    assert poses.names == tuple(features)
    assert poses.rejected == {}
    assert (poses.frame, poses.scale, poses.metric) == ("the file's", "metres", True)
    for idx, name in enumerate(poses.names):
        if name != new:
            assert poses.rotations[idx].tobytes() == truth[name].rotation.tobytes()
            assert poses.translations[idx].tobytes() == truth[name].translation.tobytes()
    errors = relative_pose_errors(found_by_name(poses), truth)
    assert errors.pair_deg.max() < 0.05
    assert np.linalg.norm(found_by_name(poses)[new].center - truth[new].center) < 1e-3
    assert len(poses.points_in_world) > 300


def test_several_new_ones_are_found_from_two(capture: Capture) -> None:
    truth, features, two_views = capture
    poses = extend_poses(known_of(truth, ["1.jpg", "4.jpg"]), features, two_views)
    errors = relative_pose_errors(found_by_name(poses), truth)
    assert errors.registered == 6
    assert errors.median_pair_deg < 0.1


def test_those_that_cannot_be_joined_are_named(capture: Capture) -> None:
    truth, features, two_views = capture
    views = {pair: TwoView.failed("a blurred picture") if "5.jpg" in pair else view for pair, view in two_views.items()}
    poses = extend_poses(known_of(truth, ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]), features, views)
    assert poses.names == ("0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg")
    assert list(poses.rejected) == ["5.jpg"]
    assert "a blurred picture" in poses.rejected["5.jpg"]


def test_a_known_camera_without_pairs_stays(capture: Capture) -> None:
    truth, features, two_views = capture
    views = {pair: view for pair, view in two_views.items() if "2.jpg" not in pair}
    poses = extend_poses(known_of(truth, ["0.jpg", "1.jpg", "2.jpg"]), features, views)
    assert poses.names == tuple(features)
    assert poses.rejected == {}
    assert poses.rotations[2].tobytes() == truth["2.jpg"].rotation.tobytes()


def test_one_known_camera_gives_no_points_to_see(capture: Capture) -> None:
    truth, features, two_views = capture
    poses = extend_poses(known_of(truth, ["0.jpg"]), features, two_views)
    assert poses.names == ("0.jpg",)
    assert len(poses.rejected) == 5
    assert all("shares enough points with a third image" in reason for reason in poses.rejected.values())


def test_without_known_cameras_nothing_is_found(capture: Capture) -> None:
    truth, features, two_views = capture
    poses = extend_poses(known_of(truth, []), features, two_views)
    assert poses.names == ()
    assert list(poses.rejected) == list(features)


def test_the_points_that_are_kept_do_not_move_the_new_one(capture: Capture) -> None:
    truth, features, two_views = capture
    known = known_of(truth, [name for name in truth if name != "5.jpg"])
    many, few = (extend_poses(known, features, two_views, min_angle_deg=angle) for angle in (1.0, 60.0))
    assert len(few.points_in_world) < 20 < len(many.points_in_world)
    np.testing.assert_array_equal(few.translations, many.translations)


def test_wrong_known_poses_reject_the_new_one(capture: Capture) -> None:
    """Cameras that do not fit the pictures give no points that a new picture could trust."""
    truth, features, two_views = capture
    names = ["0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg"]
    known = known_of(truth, names)
    wrong = replace(known, translations=known.translations[::-1].copy())
    poses = extend_poses(wrong, features, two_views)
    assert list(poses.rejected) == ["5.jpg"]
    np.testing.assert_array_equal(poses.translations, wrong.translations)


@pytest.mark.parametrize("cameras", ["sphere", "faces"])
def test_colmap_adds_the_sixth_to_five_that_do_not_move(capture: Capture, tmp_path: Path, cameras: Cameras) -> None:
    truth, features, two_views = capture
    known = known_of(truth, [name for name in truth if name != "3.jpg"])
    poses = extend_with_colmap(
        known, features, two_views, cameras=cameras, rng=np.random.default_rng(0), scratch=tmp_path
    )
    poses.check()
    assert poses.names == tuple(features)
    assert (poses.frame, poses.scale, poses.metric) == ("the file's", "metres", True)
    for idx, name in enumerate(poses.names):
        if name != "3.jpg":
            assert poses.rotations[idx].tobytes() == truth[name].rotation.tobytes()
            assert poses.translations[idx].tobytes() == truth[name].translation.tobytes()
    assert relative_pose_errors(found_by_name(poses), truth).pair_deg.max() < 0.1
    assert len(poses.points_in_world) > 300


def test_colmap_leaves_known_ones_alone_where_nothing_fits(capture: Capture, tmp_path: Path) -> None:
    truth, features, two_views = capture
    (tmp_path / "one").mkdir()
    one = extend_with_colmap(
        known_of(truth, ["0.jpg"]),
        features,
        two_views,
        cameras="sphere",
        rng=np.random.default_rng(0),
        scratch=tmp_path / "one",
    )
    assert one.names == ("0.jpg",)
    assert set(one.rejected.values()) == {"the known images give no point that it could see"}
    views = {pair: TwoView.failed("a blurred picture") if "5.jpg" in pair else view for pair, view in two_views.items()}
    poses = extend_with_colmap(
        known_of(truth, list(truth)[:4]),
        features,
        views,
        cameras="sphere",
        rng=np.random.default_rng(0),
        scratch=tmp_path,
    )
    assert poses.names == tuple(truth)[:5]
    assert list(poses.rejected) == ["5.jpg"]
    assert "a blurred picture" in poses.rejected["5.jpg"]
