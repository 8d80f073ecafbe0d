"""The vertical, from sensors, level surfaces and cameras; the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from pano_mvs.algorithms.points.floor import floor_below
from pano_mvs.algorithms.poses.frame.gauge import moved_poses
from pano_mvs.algorithms.poses.frame.upside_down import ups_of_picture
from pano_mvs.algorithms.poses.frame.vertical import (
    find_vertical,
    level_poses,
    robust_mean_direction,
    sharpest_up,
    vertical_from_cameras,
    vertical_from_sensors,
)
from pano_mvs.geometry import Rigid3, Similarity3, angle_between, rotation_from_rotvec
from pano_mvs.scene import Poses
from pano_mvs.testing.room import capture_poses, default_room, range_along
from tests.algorithms.poses.synthetic_capture import random_rotation

UP = np.array([0.0, -1.0, 0.0])
FLOOR_Y = 1.3


def angle_deg(first: ArrayLike, second: ArrayLike) -> float:
    return float(np.rad2deg(angle_between(first, second)))


def with_points(poses: list[Rigid3], points: ArrayLike) -> Poses:
    named = {f"{number}.jpg": pose for number, pose in enumerate(poses)}
    bare = Poses.without_points(named, frame="", scale="", metric=False)
    xyz = np.asarray(points, np.float64)
    count = len(xyz)
    return replace(
        bare,
        points_in_world=xyz,
        point_colors_rgb=np.zeros((count, 3), np.uint8),
        point_errors_rad=np.full(count, 0.001, np.float32),
    )


def room_poses(seed: int, *, cameras: int = 4, tilt_deg: float = 5.0, points: int = 300) -> Poses:
    """Tilted cameras in the synthetic room, and points on what they see, with the noise of triangulation."""
    rng = np.random.default_rng(seed)
    poses = capture_poses(cameras, seed=seed, tilt_deg=tilt_deg)
    found = []
    for pose in poses:
        rays = rng.normal(size=(points, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        ranges = range_along(default_room(), pose.center, rays)
        ranges *= 1 + rng.normal(size=points) * np.deg2rad(0.1) * ranges / 0.5
        found.append((pose.center + ranges[:, None] * rays)[np.isfinite(ranges)])
    return with_points(poses, np.concatenate(found))


def sensed(poses: Poses, rng: np.random.Generator, noise_deg: float) -> dict[str, tuple[float, float, float]]:
    """What the sensors of level-world cameras read."""
    tilts = rotation_from_rotvec(np.deg2rad(noise_deg) * rng.normal(size=(len(poses.names), 3)))
    readings = np.einsum("nij,njk,k->ni", tilts, poses.rotations, UP)
    return {name: tuple(reading) for name, reading in zip(poses.names, readings, strict=True)}


@pytest.mark.parametrize("seed", range(5))
def test_mean_direction_ignores_a_third_of_wild_readings(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = random_rotation(rng)[0]
    good = true + np.deg2rad(0.3) * rng.normal(size=(20, 3))
    directions = np.concatenate([rng.normal(size=(10, 3)), good])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    mean, deviations_deg, kept = robust_mean_direction(directions)
    assert angle_deg(mean, true) < 0.3
    assert kept[10:].sum() >= 18
    assert deviations_deg[10:].max() < 2


@pytest.mark.parametrize("seed", range(3))
def test_sensors_find_the_vertical_in_any_world_despite_wrong_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = room_poses(seed, cameras=8, points=1)
    readings = sensed(poses, rng, 0.5) | {
        "3.jpg": (1.0, 0.0, 0.0),
        "5.jpg": (0.0, 0.6, 0.8),
        "not there.jpg": (1, 0, 0),
    }
    turn = random_rotation(rng)
    vertical = vertical_from_sensors(moved_poses(poses, Similarity3(2.0, turn, np.ones(3))), readings)
    assert vertical
    assert angle_deg(vertical.up_in_world, turn @ UP) < 0.6
    assert "6 of 8 panoramas" in vertical.evidence
    assert vertical.disagreement_deg < 1.5


def test_sensors_that_contradict_each_other_are_no_evidence() -> None:
    poses = room_poses(0, cameras=6, points=1)
    rng = np.random.default_rng(0)
    readings = {name: tuple(random_rotation(rng)[0]) for name in poses.names}
    vertical = vertical_from_sensors(poses, readings)
    assert not vertical
    assert "disagree by" in vertical.reason
    assert "no registered panorama has pitch and roll" in vertical_from_sensors(poses, {}).reason


@pytest.mark.parametrize("seed", range(4))
def test_level_surfaces_find_the_vertical_where_cameras_are_tilted(seed: int) -> None:
    poses = room_poses(seed)
    turn = random_rotation(np.random.default_rng(seed))
    moved = moved_poses(poses, Similarity3(0.3, turn, np.ones(3)))
    from_cameras, from_structure = vertical_from_cameras(moved), find_vertical(moved, evidence="structure")
    assert from_cameras.disagreement_deg > 1
    assert angle_deg(from_structure.up_in_world, turn @ UP) < 0.35
    assert find_vertical(moved).source == "structure"


def test_without_level_surfaces_the_cameras_decide() -> None:
    rng = np.random.default_rng(1)
    poses = room_poses(1, cameras=6)
    ball = rng.normal(size=(1000, 3))
    formless = with_points([poses.cam_from_world(idx) for idx in range(6)], ball)
    assert "no clear level surfaces" in find_vertical(formless, evidence="structure").reason
    vertical = find_vertical(formless)
    assert vertical.source == "cameras"
    assert angle_deg(vertical.up_in_world, UP) < 6
    few = with_points([Rigid3.identity()] * 2, np.ones((3, 3)))
    assert "100 are needed" in find_vertical(few, evidence="structure").reason


def test_a_slope_is_not_taken_for_a_level_floor() -> None:
    """Cameras that agree within a degree outweigh a ramp that is twelve degrees off."""
    poses = room_poses(2, cameras=6, tilt_deg=0.5)
    ramp = rotation_from_rotvec([np.deg2rad(12.0), 0, 0])
    tilted = replace(poses, points_in_world=poses.points_in_world @ ramp.T)
    assert "are tilted by" in find_vertical(tilted, evidence="structure").reason
    assert angle_deg(find_vertical(tilted).up_in_world, UP) < 1


def test_sources_that_agree_are_averaged_by_precision() -> None:
    poses = room_poses(4, cameras=8)
    alone = {"structure": find_vertical(poses, evidence="structure"), "cameras": vertical_from_cameras(poses)}
    mean = find_vertical(poses)
    precisions = {each: vertical.uncertainty_deg**-2 for each, vertical in alone.items()}
    assert mean.weights == pytest.approx({each: one / sum(precisions.values()) for each, one in precisions.items()})
    assert mean.uncertainty_deg == pytest.approx(sum(precisions.values()) ** -0.5)
    assert angle_deg(mean.up_in_world, UP) < mean.uncertainty_deg


def test_a_source_that_disagrees_with_the_most_precise_one_has_no_weight() -> None:
    poses = room_poses(2, cameras=6, tilt_deg=0.5)
    ramp = rotation_from_rotvec([np.deg2rad(2.2), 0, 0])
    tilted = replace(poses, points_in_world=poses.points_in_world @ ramp.T)
    vertical = find_vertical(tilted)
    assert vertical.weights == {"structure": 1.0}
    assert vertical.uncertainty_deg == find_vertical(tilted, evidence="structure").uncertainty_deg


def test_a_single_camera_is_held_nearly_upright() -> None:
    tilted = with_points([Rigid3(rotation_from_rotvec([np.deg2rad(5.0), 0, 0]), np.zeros(3))], np.ones((3, 3)))
    vertical = find_vertical(tilted)
    assert vertical.evidence == "the up direction of a single camera"
    assert 2 < vertical.uncertainty_deg < 3
    assert angle_deg(vertical.up_in_world, UP) == pytest.approx(5)


def test_cameras_held_at_random_tell_nothing() -> None:
    rng = np.random.default_rng(3)
    poses = with_points(
        [Rigid3.from_center(random_rotation(rng), rng.normal(size=3)) for _ in range(6)], np.zeros((0, 3))
    )
    vertical = find_vertical(poses)
    assert not vertical
    assert "not held upright" in vertical.reason
    levelled, told = level_poses(poses)
    assert levelled is poses
    assert told.reason == vertical.reason


@pytest.mark.parametrize("scale", [0.01, 1.0, 40.0])
def test_floor_is_found_under_tables_in_any_unit_and_world(scale: float) -> None:
    for seed in range(3):
        turn = random_rotation(np.random.default_rng(seed))
        poses = room_poses(seed)
        true = FLOOR_Y - np.median(poses.centers[:, 1])
        moved = moved_poses(poses, Similarity3(scale, turn, scale * np.ones(3)))
        floor = floor_below(moved.points_in_world, moved.centers, turn @ UP)
        assert floor.depth == pytest.approx(scale * true, rel=0.01)
        assert floor.points > 100


def plate(rng: np.random.Generator, depth: float, half: float, count: int) -> NDArray[np.float64]:
    return np.stack(
        [rng.uniform(-half, half, count), rng.normal(depth, 0.004, count), rng.uniform(-half, half, count)], 1
    )


def test_a_table_with_more_points_than_the_floor_is_not_the_floor() -> None:
    rng = np.random.default_rng(5)
    points = np.concatenate([plate(rng, 0.7, 0.8, 400), plate(rng, 1.5, 3.0, 200), plate(rng, 2.6, 3.0, 10)])
    floor = floor_below(points, rng.normal(size=(4, 3)) * 0.1, UP)
    assert floor.depth == pytest.approx(1.5, abs=0.1)
    assert floor.points == pytest.approx(200, abs=20)


def test_a_floor_lies_below_the_lowest_camera() -> None:
    rng = np.random.default_rng(6)
    centers = np.array([[0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [0.5, 1.2, 0]])
    floor = floor_below(np.concatenate([plate(rng, 0.7, 0.8, 400), plate(rng, 2.0, 3.0, 50)]), centers, UP)
    assert floor.depth == pytest.approx(2.0, abs=0.05)
    assert not floor_below(plate(rng, 0.7, 0.8, 400), centers, UP)


def test_where_nothing_lies_below_there_is_no_floor() -> None:
    above = np.random.default_rng(0).uniform(-1, 0, (200, 3))
    assert "lie below" in floor_below(above, np.zeros((2, 3)), UP).reason
    assert not floor_below(np.zeros((0, 3)), np.zeros((2, 3)), UP)


def test_layers_of_a_slanted_board_are_found_to_a_tenth_of_a_degree() -> None:
    rng = np.random.default_rng(4)
    board = np.stack([rng.uniform(-4, 4, 800), rng.normal(1.5, 0.005, 800), rng.uniform(-4, 4, 800)], axis=1)
    clutter = rng.uniform(-2, 2, (400, 3))
    tilt = rotation_from_rotvec(np.deg2rad([7.0, 0, -9.0]))
    layers = sharpest_up(np.concatenate([board, clutter]) @ tilt.T, np.zeros((3, 3)), UP)
    assert angle_deg(layers.up, tilt @ UP) < 0.15


@pytest.mark.parametrize("count", [150, 600, 3000])
def test_points_without_level_surfaces_have_no_layers(count: int) -> None:
    rng = np.random.default_rng(count)
    ball = rng.normal(size=(count, 3))
    walls = rng.uniform(-3, 3, (count, 3))
    axis = 2 * rng.integers(0, 2, count)
    walls[np.arange(count), axis] = 3 * np.sign(walls[np.arange(count), axis])
    sphere = 3 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    for points in (ball, walls, sphere):
        layers = sharpest_up(points, np.zeros((3, 3)), UP)
        assert not layers
        np.testing.assert_array_equal(layers.up, UP)


def place(*, ceiling: int, floor: int, textured: bool) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A panorama whose upper and lower half have a grey level each; the lower half may have texture."""
    picture = np.full((128, 256, 3), ceiling, np.uint8)
    noise = np.random.default_rng(0).normal(0, 30 if textured else 0, (64, 256, 1))
    picture[64:] = np.clip(floor + noise, 0, 255)
    return picture, np.ones(picture.shape[:2], np.bool_)


def above_a_floor(cameras: int = 4) -> Poses:
    """Upright cameras above a floor of sparse points, without a ceiling."""
    poses = capture_poses(cameras, seed=0, tilt_deg=0.0)
    points = np.random.default_rng(1).uniform((-2, FLOOR_Y, -2), (2, FLOOR_Y, 2), (200, 3))
    return with_points(poses, points)


@pytest.mark.parametrize(("ceiling", "floor", "textured"), [(220, 120, True), (120, 120, True), (30, 200, True)])
def test_upright_captures_stay_upright(ceiling: int, floor: int, textured: bool) -> None:
    poses = above_a_floor()
    pictures = {name: lambda: place(ceiling=ceiling, floor=floor, textured=textured) for name in poses.names}
    vertical = find_vertical(poses, pictures=pictures)
    assert vertical.upside_down < 0.01
    assert angle_deg(vertical.up_in_world, UP) < 1


def turned_over(poses: Poses) -> Poses:
    """The same cameras, held upside down, in the same world."""
    over = np.diag([-1.0, -1.0, 1.0])
    return replace(poses, rotations=over @ poses.rotations, translations=poses.translations @ over.T)


def test_a_capture_that_is_upside_down_is_turned_around() -> None:
    poses = turned_over(above_a_floor())
    picture, valid = place(ceiling=220, floor=120, textured=True)
    pictures = {name: lambda: (np.ascontiguousarray(picture[::-1, ::-1]), valid) for name in poses.names}
    vertical = find_vertical(poses, pictures=pictures)
    assert vertical.upside_down > 0.8
    assert angle_deg(vertical.up_in_world, UP) < 1
    level, _ = level_poses(poses, pictures=pictures)
    assert np.median(level.points_in_world[:, 1]) > 0  # the floor is below the cameras
    kept = find_vertical(poses, pictures=pictures, evidence="cameras")
    assert angle_deg(kept.up_in_world, -UP) < 1


def test_a_single_panorama_that_is_upside_down_is_found() -> None:
    picture, valid = place(ceiling=220, floor=120, textured=True)
    np.testing.assert_array_equal(ups_of_picture(picture, valid), [UP])
    np.testing.assert_array_equal(ups_of_picture(np.ascontiguousarray(picture[::-1, ::-1]), valid), [-UP])


def test_sensors_are_believed_against_the_pictures() -> None:
    poses = above_a_floor()
    picture, valid = place(ceiling=220, floor=120, textured=True)
    pictures = {name: lambda: (np.ascontiguousarray(picture[::-1, ::-1]), valid) for name in poses.names}
    sensors = dict.fromkeys(poses.names, tuple(UP))
    assert angle_deg(find_vertical(poses, sensors, pictures).up_in_world, UP) < 1
    over, sensors = turned_over(poses), dict.fromkeys(poses.names, tuple(-UP))
    vertical = find_vertical(over, sensors, pictures)
    assert vertical.weights.keys() == {"sensors", "structure"}
    assert angle_deg(vertical.up_in_world, UP) < 1
    assert find_vertical(over, sensors, evidence="sensors").weights == {"sensors": 1.0}
