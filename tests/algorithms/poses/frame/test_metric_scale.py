"""Metres from a known length."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.frame.gauge import moved_poses
from pano_mvs.algorithms.poses.frame.metric_scale import scaled_by_baseline, scaled_by_camera_height, scaled_poses
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, Similarity3
from tests.algorithms.poses.frame.test_levelling import in_cameras
from tests.algorithms.poses.frame.test_vertical import FLOOR_Y, UP, room_poses, with_points
from tests.algorithms.poses.synthetic_capture import random_rotation


@pytest.mark.parametrize("factor", [0.01, 1.0, 37.5])
def test_all_lengths_grow_alike_and_no_angle_changes(factor: float) -> None:
    poses = room_poses(1)
    scaled = scaled_poses(poses, factor, origin="a test")
    np.testing.assert_allclose(in_cameras(scaled), factor * np.array(in_cameras(poses)), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(scaled.point_errors_rad, poses.point_errors_rad)
    np.testing.assert_allclose(scaled.rotations, poses.rotations, atol=1e-12)
    assert (scaled.metric, scaled.scale, scaled.frame) == (True, "metres, by a test", poses.frame)
    scaled.check()


def test_a_baseline_gets_its_length() -> None:
    scaled = scaled_by_baseline(room_poses(2), "3.jpg", "1.jpg", metres=1.2)
    assert np.linalg.norm(scaled.centers[3] - scaled.centers[1]) == pytest.approx(1.2)
    assert "the baseline of 1.2 m from 3.jpg to 1.jpg" in scaled.scale


def test_what_gives_no_scale_is_refused() -> None:
    poses = room_poses(2)
    with pytest.raises(UsageError, match=r"image nothing.jpg is not registered \(no such image\)"):
        scaled_by_baseline(poses, "nothing.jpg", "1.jpg", metres=1)
    with pytest.raises(UsageError, match="taken in one place"):
        scaled_by_baseline(poses, "1.jpg", "1.jpg", metres=1)
    with pytest.raises(UsageError, match="taken in one place"):
        scaled_by_baseline(with_points([Rigid3.identity()] * 3, []), "0.jpg", "1.jpg", metres=1)
    for factor in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(UsageError, match="positive number"):
            scaled_poses(poses, factor, origin="a test")


@pytest.mark.parametrize("seed", range(3))
def test_the_height_above_the_floor_gives_the_scale(seed: int) -> None:
    poses = room_poses(seed)
    height_m = FLOOR_Y - float(np.median(poses.centers[:, 1]))
    turn = random_rotation(np.random.default_rng(seed))
    moved = moved_poses(poses, Similarity3(0.4, turn, np.ones(3)))
    scaled, floor = scaled_by_camera_height(moved, turn @ UP, metres=height_m)
    assert floor
    ratio = np.linalg.norm(scaled.centers[1] - scaled.centers[0]) / np.linalg.norm(poses.centers[1] - poses.centers[0])
    assert ratio == pytest.approx(1, rel=0.01)
    assert "above a floor of" in scaled.scale


def test_without_a_floor_the_poses_stay() -> None:
    poses = with_points([Rigid3.identity(), Rigid3.from_center(np.eye(3), [1.0, 0, 0])], np.zeros((0, 3)))
    same, floor = scaled_by_camera_height(poses, UP, metres=1.6)
    assert same is poses
    assert "lie below the cameras" in floor.reason
