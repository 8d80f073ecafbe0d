"""A level world with the first camera as its origin, and north where compasses agree."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.frame.gauge import moved_poses
from pano_mvs.algorithms.poses.frame.vertical import level_poses
from pano_mvs.geometry import Similarity3, rotation_from_rotvec
from pano_mvs.scene import Poses
from tests.algorithms.poses.frame.test_vertical import UP, room_poses, sensed
from tests.algorithms.poses.synthetic_capture import random_rotation


def in_cameras(poses: Poses) -> list[NDArray[np.float64]]:
    return [poses.cam_from_world(idx).apply(poses.points_in_world) for idx in range(len(poses.names))]


@pytest.mark.parametrize("seed", range(3))
def test_levelling_undoes_any_tilt_and_changes_nothing_else(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = room_poses(seed)
    tilted = moved_poses(poses, Similarity3(1.0, random_rotation(rng), rng.normal(size=3)))
    level, vertical = level_poses(tilted, sensed(poses, rng, 0.0), evidence="sensors")
    assert vertical.source == "sensors"
    np.testing.assert_allclose(
        np.einsum("nij,j->ni", level.rotations, UP), list(sensed(poses, rng, 0.0).values()), atol=1e-7
    )
    np.testing.assert_array_equal(level.centers[0], 0)
    np.testing.assert_allclose(in_cameras(level), in_cameras(tilted), atol=1e-9)
    assert "y down along gravity, by the pitch and roll that 4 of 4 panoramas state" in level.frame
    assert (level.scale, level.metric) == (tilted.scale, tilted.metric)
    level.check()


def test_levelling_twice_is_levelling_once() -> None:
    readings = sensed(room_poses(1), np.random.default_rng(1), 0.3)
    turned = moved_poses(room_poses(1), Similarity3(1.0, rotation_from_rotvec([0.2, 0.1, -0.3]), UP))
    once, _ = level_poses(turned, readings, evidence="sensors")
    twice, _ = level_poses(once, readings, evidence="sensors")
    np.testing.assert_allclose(twice.rotations, once.rotations, atol=1e-9)
    np.testing.assert_allclose(twice.translations, once.translations, atol=1e-9)


def test_a_level_world_keeps_its_z_axis() -> None:
    poses = room_poses(2)
    level, _ = level_poses(poses, sensed(poses, np.random.default_rng(0), 0.0), evidence="sensors")
    np.testing.assert_allclose(level.rotations, poses.rotations, atol=1e-7)


@pytest.mark.parametrize("north_deg", [-170.0, 0.0, 35.0, 179.0])
def test_agreeing_headings_turn_z_north(north_deg: float) -> None:
    rng = np.random.default_rng(5)
    poses = room_poses(3, cameras=6, points=1)
    forward = poses.rotations[:, 2]
    # In this world, seen from above, north lies at azimuth `north_deg` and azimuth grows clockwise, as headings do.
    azimuth_deg = np.rad2deg(np.arctan2(forward[:, 0], forward[:, 2]))
    headings = dict(zip(poses.names, (np.round(azimuth_deg - north_deg + rng.normal(0, 2, 6)) % 360), strict=True))
    headings["5.jpg"] = (headings["5.jpg"] + 120) % 360
    level, _ = level_poses(poses, sensed(poses, rng, 0.0), headings)
    north = rotation_from_rotvec([0, np.deg2rad(north_deg), 0]) @ [0.0, 0.0, 1.0]
    moved = level.rotations[0].T @ poses.rotations[0] @ north
    assert np.rad2deg(np.arccos(moved[2])) < 3
    assert "z north, by 6 compass headings" in level.frame


@pytest.mark.parametrize(
    ("headings", "words"),
    [
        ({"0.jpg": 0.0, "1.jpg": 0.0, "2.jpg": 0.0}, "z close to"),
        ({"0.jpg": 12.0}, "z close to"),
        ({f"{n}.jpg": 60.0 * n * n for n in range(6)}, "the compass headings disagree by"),
    ],
)
def test_headings_that_say_nothing_turn_nothing(headings: dict[str, float], words: str) -> None:
    poses = room_poses(3, cameras=6, points=1)
    readings = sensed(poses, np.random.default_rng(0), 0.0)
    level, _ = level_poses(poses, readings, headings)
    plain, _ = level_poses(poses, readings)
    np.testing.assert_array_equal(level.rotations, plain.rotations)
    assert words in level.frame
