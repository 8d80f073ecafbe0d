"""The vertical from line segments in panoramas of stripes, whose edges are vertical in the world."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.frame.vertical import find_vertical, level_poses
from pano_mvs.algorithms.poses.frame.vertical_lines import Picture, Segments, find_segments, up_from_lines
from pano_mvs.geometry import Rigid3, angle_between, ray_grid, rotation_from_rotvec
from pano_mvs.scene import Poses, WorldAxes

UP = np.array([0.0, -1.0, 0.0])
SIZE_HW = (128, 256)


def angle_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    return float(np.rad2deg(angle_between(first, second)))


def stripes(rotation: NDArray[np.float64], *, phase: float) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A panorama of a round room with vertical stripes."""
    rays = ray_grid(SIZE_HW) @ rotation
    azimuth = np.arctan2(rays[..., 0], rays[..., 2])
    grey = np.where(np.floor(azimuth * 10 / np.pi + phase) % 2 == 0, 200, 60).astype(np.uint8)
    return np.repeat(cv2.GaussianBlur(grey, (0, 0), 0.7)[..., None], 3, axis=-1), np.ones(SIZE_HW, np.bool_)


def capture(count: int = 2, *, tilt_deg: float = 4.0, seed: int = 0) -> tuple[Poses, dict[str, Picture]]:
    rng = np.random.default_rng(seed)
    rotations: dict[str, NDArray[np.float64]] = {}
    pictures: dict[str, Picture] = {}
    for idx in range(count):
        tilt = np.deg2rad(tilt_deg) * rng.normal(size=3) * [1, 0, 1]
        rotations[f"{idx}"] = rotation_from_rotvec(tilt) @ rotation_from_rotvec([0, rng.uniform(-3, 3), 0])
        pictures[f"{idx}"] = partial(stripes, rotations[f"{idx}"], phase=0.3 * idx)
    cameras = {name: Rigid3(rotation, rng.normal(size=3)) for name, rotation in rotations.items()}
    return Poses.without_points(cameras, frame="", scale="", metric=False), pictures


@pytest.mark.parametrize("seed", range(3))
def test_stripes_point_up_whatever_the_tilt_of_the_cameras(seed: int) -> None:
    poses, pictures = capture(seed=seed)
    vertical = find_vertical(poses, pictures=pictures, evidence="lines")
    assert vertical
    assert angle_deg(vertical.up_in_world, UP) < 0.15
    assert 0.1 <= vertical.uncertainty_deg < 0.3
    assert "vertical lines in the pictures" in vertical.evidence


def test_one_camera_suffices() -> None:
    poses, pictures = capture(1, seed=4)
    level, vertical = level_poses(poses, pictures=pictures)
    assert vertical.source == "lines"
    assert angle_deg(poses.rotations[0] @ UP, UP) > 1  # the camera is tilted
    assert angle_deg(level.rotations[0] @ UP, poses.rotations[0] @ UP) < 0.15
    assert "uncertain by 0.1°" in level.frame


def stated(poses: Poses, up_in_cam: NDArray[np.float64]) -> dict[str, tuple[float, float, float]]:
    """The same pitch and roll in the metadata of all panoramas."""
    up = up_in_cam / np.linalg.norm(up_in_cam)
    return dict.fromkeys(poses.names, (float(up[0]), float(up[1]), float(up[2])))


@pytest.mark.parametrize("count", [1, 3])
def test_pitch_and_roll_that_levelled_pictures_still_state_are_not_used(count: int) -> None:
    """A program had levelled the pictures and left the camera's pitch and roll in the metadata: the world was tilted.

    74 vertical lines were dropped without a word.
    """
    cameras = {f"{idx}": Rigid3(np.eye(3), np.array([idx, 0.0, 0.0])) for idx in range(count)}
    poses = Poses.without_points(cameras, frame="", scale="", metric=False)
    pictures: dict[str, Picture] = {name: partial(stripes, np.eye(3), phase=0.3) for name in cameras}
    sensors = stated(poses, np.array([0.2, -0.9, 0.28]))
    vertical = find_vertical(poses, sensors, pictures)
    assert angle_deg(vertical.up_in_world, UP) < 0.15
    assert vertical.source == "lines"
    assert "sensors" not in vertical.weights
    assert "are 20.9° off" in vertical.unused
    assert "vertical lines in the pictures" in vertical.unused
    assert angle_deg(find_vertical(poses, sensors, pictures, evidence="sensors").up_in_world, UP) > 20


def test_cameras_that_are_held_askew_believe_their_sensors() -> None:
    poses, pictures = capture(3, tilt_deg=0.0)
    askew = rotation_from_rotvec([0.3, 0.0, 0.2])
    turned = replace(poses, rotations=askew @ poses.rotations)
    pictures = {
        name: partial(stripes, rotation, phase=0.3)
        for name, rotation in zip(poses.names, turned.rotations, strict=True)
    }
    vertical = find_vertical(turned, stated(poses, askew @ UP), pictures)
    assert angle_deg(vertical.up_in_world, UP) < 0.15
    assert vertical.weights.keys() == {"lines", "sensors"}
    assert not vertical.unused


def test_masked_lines_do_not_count() -> None:
    poses, pictures = capture(1)
    rotations = dict(zip(poses.names, poses.rotations, strict=True))
    image, valid = pictures["0"]()
    assert len(find_segments({"0": lambda: (image, valid)}, rotations, UP).weights) > 10
    valid = np.zeros_like(valid)
    assert len(find_segments({"0": lambda: (image, valid)}, rotations, UP).weights) == 0


def test_blobs_have_no_vertical() -> None:
    rng = np.random.default_rng(3)
    grey = cv2.GaussianBlur(rng.uniform(0, 255, SIZE_HW).astype(np.float32), (0, 0), 4)
    grey = cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    poses, _ = capture(1)
    blobs: dict[str, Picture] = {"0": lambda: (np.repeat(grey[..., None], 3, -1), np.ones(SIZE_HW, bool))}
    vertical = find_vertical(poses, pictures=blobs, evidence="lines")
    assert not vertical
    assert "too few" in vertical.reason or "no clear vertical lines" in vertical.reason


def random_segments(up: NDArray[np.float64], *, noise_deg: float, azimuths_rad: NDArray[np.float64]) -> Segments:
    """Segments whose planes contain `up`, at given azimuths, half of them plus as many in any direction."""
    rng = np.random.default_rng(1)
    normals = np.stack(
        [np.cos(azimuths_rad), rng.normal(size=len(azimuths_rad)) * np.deg2rad(noise_deg), np.sin(azimuths_rad)],
        axis=-1,
    )
    to_up = rotation_from_rotvec(np.cross(UP, up))
    other = rng.normal(size=normals.shape)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    return Segments(
        np.concatenate([normals @ to_up.T, other]),
        np.full(2 * len(normals), 0.2),
        np.arange(2 * len(normals)) % 8,
    )


@pytest.mark.parametrize("noise_deg", [0.1, 0.3])
def test_the_uncertainty_grows_with_the_noise(noise_deg: float) -> None:
    azimuths = np.random.default_rng(2).uniform(0, 2 * np.pi, 400)
    up = np.array([np.sin(0.1), -np.cos(0.1), 0.0])
    lines = up_from_lines(random_segments(up, noise_deg=noise_deg, azimuths_rad=azimuths), UP)
    expected_deg = float(angle_between(rotation_from_rotvec(np.cross(UP, up)) @ UP, UP))
    assert lines
    assert expected_deg > 0
    assert angle_deg(lines.up, rotation_from_rotvec(np.cross(UP, up)) @ UP) < 4 * lines.uncertainty_deg
    jackknife = np.sqrt(lines.uncertainty_deg**2 - 0.1**2)
    assert 0.3 < jackknife / (noise_deg * np.sqrt(2 * 2 / 400)) < 3


def test_lines_at_one_azimuth_do_not_determine_the_vertical() -> None:
    azimuths = np.random.default_rng(2).normal(0.4, 0.01, 200)
    lines = up_from_lines(random_segments(UP, noise_deg=0.05, azimuths_rad=azimuths), UP)
    assert not lines
    assert "in one direction" in lines.reason or "no clear" in lines.reason


def test_an_uncertain_vertical_leaves_the_poses_as_they_are() -> None:
    rotations = [rotation_from_rotvec([0, 0, np.deg2rad(deg)]) for deg in (-12, 12)]
    cameras = {f"{idx}": Rigid3(rotation, np.array([idx, 0.0, 0])) for idx, rotation in enumerate(rotations)}
    poses = Poses.without_points(cameras, frame="as before", scale="", metric=False)
    same, vertical = level_poses(poses, evidence="cameras")
    assert same is poses
    assert "is uncertain by 10" in vertical.reason
    assert level_poses(poses, evidence="cameras", max_uncertainty_deg=15)[1]


def test_a_world_that_gps_has_turned_stays() -> None:
    poses, pictures = capture()
    placed = replace(poses, axes=WorldAxes.NORTH, origin_lla=(47.5, 8.25, 410.0))
    same, vertical = level_poses(placed, pictures=pictures)
    assert same is placed
    assert "GPS has already turned it" in vertical.reason
