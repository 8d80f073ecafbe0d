"""Two runs are aligned by the cameras that stayed, so that those that moved are found."""

from __future__ import annotations

import numpy as np
import pytest
from pano_mvs_lineage.alignment import align_runs, camera_changes

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from tests.algorithms.poses.synthetic_capture import random_rotation

Cameras = dict[str, Rigid3]
SCALE = 2.5


def cameras_at(centers: np.ndarray, seed: int = 0) -> Cameras:
    rng = np.random.default_rng(seed)
    turns = [random_rotation(rng) for _ in centers]
    return {f"{idx:03d}": Rigid3(turn, -turn @ centers[idx]) for idx, turn in enumerate(turns)}


def in_another_world(cameras: Cameras) -> Cameras:
    turn = random_rotation(np.random.default_rng(7))
    return {
        name: Rigid3(pose.rotation @ turn.T, -pose.rotation @ turn.T @ (SCALE * turn @ pose.center + [1, 2, 3]))
        for name, pose in cameras.items()
    }


def moved_by(pose: Rigid3, step: np.ndarray) -> Rigid3:
    return Rigid3(pose.rotation, -pose.rotation @ (pose.center + step))


@pytest.mark.parametrize("count", [4, 9, 60])
def test_one_camera_that_moved_is_the_only_one(count: int) -> None:
    """Its movement was spread over all cameras by least squares: 4 of 4 moved, and turned by .7°."""
    before = cameras_at(np.random.default_rng(count).uniform(-1, 1, (count, 3)))
    after = in_another_world(before | {"002": moved_by(before["002"], np.array([0.1, 0, 0]))})
    fit = align_runs(before, after)
    assert fit.scale == pytest.approx(SCALE, rel=1e-6)
    moved, turned_deg = camera_changes(fit, before, after)
    assert np.flatnonzero(moved > 1e-6).tolist() == [2]
    assert turned_deg.max() < 1e-4
    extent = max(float(np.linalg.norm(a.center - b.center)) for a in after.values() for b in after.values())
    assert moved[2] == pytest.approx(0.1 * SCALE / extent, rel=1e-6)


def test_a_part_of_the_cameras_that_moved_together_is_found() -> None:
    before = cameras_at(np.random.default_rng(3).uniform(-1, 1, (11, 3)))
    part = {name: moved_by(before[name], np.array([0, 0.2, 0])) for name in list(before)[:4]}
    after = in_another_world(before | part)
    moved, _ = camera_changes(align_runs(before, after), before, after)
    assert np.flatnonzero(moved > 1e-6).tolist() == [0, 1, 2, 3]


def test_noise_across_a_walk_turns_no_camera() -> None:
    """The centres of a straight walk hardly determine the turn about it: all cameras were said to have turned."""
    rng = np.random.default_rng(5)
    centers = np.arange(12)[:, None] * np.array([1.0, 0, 0]) + rng.normal(0, 0.02, (12, 3))
    before = cameras_at(centers)
    after = in_another_world({name: moved_by(pose, rng.normal(0, 0.005, 3)) for name, pose in before.items()})
    moved, turned_deg = camera_changes(align_runs(before, after), before, after)
    assert np.median(turned_deg) < 0.1
    assert np.median(moved) < 0.002


def test_three_cameras_are_fitted_by_least_squares_and_one_place_by_nothing() -> None:
    before = cameras_at(np.eye(3))
    after = in_another_world(before | {"000": moved_by(before["000"], np.array([0.1, 0, 0]))})
    assert (camera_changes(align_runs(before, after), before, after)[0] > 1e-3).all()
    same = cameras_at(np.zeros((5, 3)))
    with pytest.raises(UsageError, match="coincide"):
        align_runs(same, same)
    assert np.allclose(camera_changes(align_runs(before, before), before, before), 0, atol=1e-6)
