"""Rays that start at the lenses of a rig give better poses, and metres, from their known distance."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, RobustLoss, adjust_bundle
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.adjustment.uncertainty import OffsetScale, estimate_offset_scale
from pano_mvs.algorithms.poses.frame.metric_scale import scaled_poses
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, rotation_from_rotvec, spiral_rays
from pano_mvs.scene.pose_groups import join_groups, split_groups
from tests.algorithms.poses.rig_capture import RigCapture, rig_capture


def stated_uncertainty(scale: str) -> float:
    match = re.search(r"uncertain by ([\d.]+) %", scale)
    assert match is not None, scale
    return float(match[1]) / 100


@pytest.mark.parametrize(("offset_m", "distance"), [(0.03, 3.0), (0.03, np.inf), (0.1, 3.0)])
def test_poses_are_several_times_better_than_those_of_a_central_camera(offset_m: float, distance: float) -> None:
    capture = rig_capture(offset_m=offset_m, stitch_distance_m=distance)
    central, known = refine_poses(capture.poses), refine_poses(capture.poses, rigs=capture.rigs)
    assert known.metric
    assert "metres, by the distance of " in known.scale
    assert capture.scale_error(known) < 4 * stated_uncertainty(known.scale) < 0.05
    assert not central.metric
    for better, worse in zip(capture.errors(known), capture.errors(central), strict=True):
        assert 3 * better < worse
    assert capture.errors(known)[1] < 0.01
    assert known.center_stds is not None
    assert np.median(known.center_stds[1:]) < 0.001


def test_track_bearings_stay_those_of_the_panoramas() -> None:
    capture = rig_capture()
    known = refine_poses(capture.poses, rigs=capture.rigs)
    before = {tuple(np.round(ray, 9)) for ray in capture.poses.track_bearings.tolist()}
    after = {tuple(np.round(ray, 9)) for ray in known.track_bearings.tolist()}
    assert 0.9 * len(before) < len(after) < 0.97 * len(before)  # without those next to the seam
    assert len(after - before) < 0.001 * len(after)  # but for rounding
    assert np.median(known.point_errors_rad) < np.radians(0.06)


def test_a_tiny_offset_gives_no_unit_and_changes_nothing() -> None:
    capture = rig_capture(offset_m=0.0005)
    known, central = refine_poses(capture.poses, rigs=capture.rigs), refine_poses(capture.poses)
    assert not known.metric
    assert known.scale == "arbitrary"
    assert np.array_equal(known.centers, central.centers)


@pytest.mark.parametrize("metric", [False, True])
def test_an_assumed_distance_helps_but_gives_no_metres(metric: bool) -> None:
    capture = rig_capture()
    rigs = {name: replace(rig, metric=False) for name, rig in capture.rigs.items()}
    known = refine_poses(replace(capture.poses, metric=metric), rigs=rigs)
    assert known.metric == metric
    assert known.scale == capture.poses.scale
    assert np.linalg.norm(known.centers[1]) == pytest.approx(np.linalg.norm(capture.poses.centers[1]), rel=0.05)
    assert 3 * capture.errors(known)[0] < capture.errors(refine_poses(capture.poses))[0]


def test_lenses_in_one_place_are_a_central_camera() -> None:
    capture = rig_capture()
    first, second = (Rigid3(pose.rotation, np.zeros(3)) for pose in capture.rig.lens_from_rig)
    rigs = {name: replace(rig, lens_from_rig=(first, second)) for name, rig in capture.rigs.items()}
    known, central = refine_poses(capture.poses, rigs=rigs), refine_poses(capture.poses)
    assert np.array_equal(known.centers, central.centers)
    assert not known.metric


@pytest.mark.parametrize(("offset_m", "seed"), [(0.4, 3), (0.6, 1), (0.6, 2)])
def test_an_offset_comparable_with_the_room_is_not_trusted_if_it_does_not_converge(offset_m: float, seed: int) -> None:
    """With 0.6 m and seed 1, a wrong solution that leaves out two thirds of the key points stated 1.9 %."""
    capture = rig_capture(offset_m=offset_m, stitch_distance_m=np.inf, points=300, seed=seed)
    assert not refine_poses(capture.poses, rigs=capture.rigs).metric


def test_the_unit_is_found_although_the_offsets_are_large_for_a_central_start() -> None:
    capture = rig_capture(offset_m=0.3, stitch_distance_m=np.inf, points=300)
    assert capture.scale_error(refine_poses(capture.poses, rigs=capture.rigs)) < 0.005


def test_poses_in_metres_keep_their_unit_and_gain_from_the_offsets() -> None:
    capture = rig_capture(offset_m=0.05)
    metric = scaled_poses(capture.poses, 1.7, origin="a tape measure")
    known, central = refine_poses(metric, rigs=capture.rigs), refine_poses(metric)
    assert known.scale == "metres, by a tape measure"
    assert 3 * capture.errors(known)[1] < capture.errors(central)[1]


def test_images_without_a_rig_are_central_cameras() -> None:
    """Half of the capture is from another camera, whose rays start at its centre."""
    capture, other = rig_capture(offset_m=0.05), rig_capture(offset_m=1e-9)
    mixed_bearings = np.where(
        (capture.poses.track_image_idx % 2 == 0)[:, None], capture.poses.track_bearings, other.poses.track_bearings
    )
    poses = replace(capture.poses, track_bearings=mixed_bearings)
    rigs = {name: capture.rig for idx, name in enumerate(poses.names) if idx % 2 == 0}
    known, wrong = refine_poses(poses, rigs=rigs), refine_poses(poses, rigs=capture.rigs)
    assert 3 * capture.errors(known)[1] < capture.errors(wrong)[1]
    assert capture.scale_error(known) < 0.03


def test_poses_without_points_are_returned_unchanged() -> None:
    capture = rig_capture(points=1)
    bare = replace(
        capture.poses,
        points_in_world=np.zeros((0, 3)),
        point_colors_rgb=np.zeros((0, 3), np.uint8),
        point_errors_rad=np.zeros(0, np.float32),
        track_point_idx=np.zeros(0, np.int32),
        track_image_idx=np.zeros(0, np.int32),
        track_bearings=np.zeros((0, 3)),
    )
    assert refine_poses(bare, rigs=capture.rigs).centers == pytest.approx(bare.centers)


def ball_bundle(units_per_m: float, *, noise_rad: float, seed: int = 0) -> Bundle:
    """Return true cameras and points around them, rays with random origins, and their true unit."""
    rng = np.random.default_rng(seed)
    points = spiral_rays(150) * rng.uniform(2, 4, (150, 1))
    centers = rng.normal(0, 0.4, (5, 3))
    rotations = rotation_from_rotvec(rng.normal(0, 1, (5, 3)))
    point_idx, image_idx = (idx.astype(np.int32) for idx in np.nonzero(np.ones((150, 5))))
    offsets_m = rng.normal(0, 0.02, (len(point_idx), 3))
    rays = np.einsum("tij,tj->ti", rotations[image_idx], points[point_idx] - centers[image_idx])
    rays = rays - units_per_m * offsets_m
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays += rng.normal(0, noise_rad, rays.shape)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return Bundle(rotations, centers, points, point_idx, image_idx, rays, None, offsets_m, units_per_m)


@pytest.mark.parametrize("start", [0.0, 0.5, 1.6])
def test_one_step_finds_the_unit_from_any_start(start: float) -> None:
    bundle = ball_bundle(1.5, noise_rad=0.0)
    scale = estimate_offset_scale(replace(bundle, units_per_m=start), RobustLoss("huber", 0.1), neighbour=1)
    assert scale.units_per_m == pytest.approx(1.5, rel=0.02)


def test_the_stated_uncertainty_is_that_of_the_unit() -> None:
    errors = []
    for seed in range(12):
        bundle = ball_bundle(1.5, noise_rad=0.002, seed=seed)
        adjusted = adjust_bundle(bundle, RobustLoss("huber", 0.1))
        held = np.linalg.norm(adjusted.centers[1] - adjusted.centers[0])
        unit = held / np.linalg.norm(bundle.centers[1] - bundle.centers[0])
        scale = estimate_offset_scale(adjusted, RobustLoss("huber", 0.1), neighbour=1)
        errors.append((scale.units_per_m / unit - 1.5) / (scale.std / unit))
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 2


def test_without_offsets_there_is_no_unit() -> None:
    bundle = replace(ball_bundle(1.0, noise_rad=0.0), offsets_m=None)
    with pytest.raises(UsageError, match="without offsets of its rays has no unit"):
        estimate_offset_scale(bundle, RobustLoss("huber", 0.1), neighbour=1)
    zero = replace(ball_bundle(1.0, noise_rad=0.0), offsets_m=np.zeros((750, 3)))
    assert estimate_offset_scale(zero, RobustLoss("huber", 0.1), neighbour=1).std == np.inf
    assert OffsetScale(-1.0, 0.1).relative_std == np.inf


def test_captures_of_the_tests_have_the_truth_that_they_state() -> None:
    capture: RigCapture = rig_capture(noise_deg=0.0)
    exact = replace(
        capture.poses,
        rotations=np.array([pose.rotation for pose in capture.true]),
        translations=np.array([pose.translation for pose in capture.true]),
    )
    assert capture.errors(exact) == pytest.approx((0, 0), abs=1e-5)


def test_groups_have_a_unit_each() -> None:
    first, second = rig_capture(offset_m=0.05, points=200), rig_capture(offset_m=0.05, points=200, unit=0.6, seed=1)
    renamed = replace(second.poses, names=tuple(f"other_{name}" for name in second.poses.names))
    rigs = first.rigs | dict.fromkeys(renamed.names, second.rig)
    refined = split_groups(refine_poses(join_groups([first.poses, renamed]), rigs=rigs))
    for capture, group in zip((first, second), refined, strict=True):
        assert group.metric
        assert capture.scale_error(group) < 0.02
