from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

from pano_mvs.algorithms.poses.adjustment.bundle import (
    Bundle,
    RobustLoss,
    adjust_bundle,
    reduced_cameras,
)
from pano_mvs.algorithms.poses.adjustment.camera_system import camera_span, dense_from_band
from pano_mvs.algorithms.poses.adjustment.kernels_bundle import moved_points, ray_errors, reduced_system
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.adjustment.tracks import triangulate_tracks
from pano_mvs.algorithms.poses.frame.gauge import first_neighbour, in_gauge_of, moved_poses
from pano_mvs.algorithms.poses.placement.resection import refine_resection
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, Similarity3, geodesic_angle, rotation_from_rotvec
from pano_mvs.geometry.pose_errors import relative_pose_errors
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.pose_groups import split_groups
from tests.algorithms.poses.synthetic_capture import (
    noisy_bearings,
    points_in_box,
    random_poses,
    random_rotation,
    synthetic_features,
    synthetic_two_views,
)
from tests.oracles.poses import reduced_system_dense

Capture = tuple[dict[str, Rigid3], dict[str, Features], dict[tuple[str, str], TwoView]]


def cameras(poses: Poses) -> dict[str, Rigid3]:
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}


def solve(features: Mapping[str, Features], views: Mapping[tuple[str, str], TwoView], **settings: Any) -> Poses:
    return solve_scaled_translation(features, views, rng=np.random.default_rng(0), **settings)


@pytest.fixture(scope="module")
def capture() -> Capture:
    rng = np.random.default_rng(11)
    truth = random_poses(rng, 5)
    features = synthetic_features(rng, truth)
    return truth, features, synthetic_two_views(rng, features)


@pytest.mark.parametrize("estimator", ["kappa", "log_median", "cauchy"])
def test_recovers_a_capture_under_noise_and_outliers(capture: Capture, estimator: str) -> None:
    truth, features, views = capture
    poses = solve(features, views, scale_estimator=estimator)
    poses.check()
    errors = relative_pose_errors(cameras(poses), truth)
    assert poses.rejected == {}
    assert poses.names == tuple(truth)
    assert errors.median_pair_deg < 0.06
    assert errors.pair_deg.max() < 0.25
    assert errors.scale_ratio_max < 0.006
    assert len(poses.points_in_world) > 300


def test_the_chain_alone_is_sound_and_adjustment_better(capture: Capture) -> None:
    truth, features, views = capture
    chained, adjusted = (
        relative_pose_errors(cameras(solve(features, views, adjust=adjust)), truth) for adjust in (False, True)
    )
    assert chained.registered == adjusted.registered == 5
    assert chained.median_pair_deg < 0.15
    assert adjusted.median_pair_deg < chained.median_pair_deg


def test_world_is_the_first_camera_and_its_first_baseline_is_one(capture: Capture) -> None:
    _, features, views = capture
    poses = solve(features, views)
    np.testing.assert_array_equal(poses.rotations[0], np.eye(3))
    np.testing.assert_array_equal(poses.translations[0], 0)
    assert np.linalg.norm(poses.centers[1]) == pytest.approx(1.0, abs=1e-12)
    refined = refine_poses(poses)
    np.testing.assert_allclose(refined.rotations[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(refined.translations[0], 0, atol=1e-12)
    assert np.linalg.norm(refined.centers[1]) == pytest.approx(1.0, abs=1e-9)


def test_refinement_halves_the_error_and_keeps_the_points(capture: Capture) -> None:
    truth, features, views = capture
    poses = solve(features, views, scale_estimator="kappa")
    bent = {
        name: Rigid3(
            rotation_from_rotvec(0.003 * np.array([1, -1, n])) @ pose.rotation, pose.translation * (1 + 0.004 * n)
        )
        for n, (name, pose) in enumerate(cameras(poses).items())
    }
    start = Poses.without_points(bent, frame=poses.frame, scale=poses.scale, metric=False)
    start = triangulate_tracks(start, features, views, max_error_deg=2.0)
    before = relative_pose_errors(bent, truth)
    refined = refine_poses(start)
    refined.check()
    after = relative_pose_errors(cameras(refined), truth)
    assert after.median_pair_deg < 0.2 * before.median_pair_deg
    assert after.median_pair_deg < 0.04
    assert after.scale_ratio_max < 0.003
    assert len(refined.points_in_world) > 0.9 * len(poses.points_in_world)
    assert np.rad2deg(refined.point_errors_rad.max()) < 0.4


def test_the_order_of_the_capture_does_not_change_the_scene(capture: Capture) -> None:
    truth, features, views = capture
    backwards = {name: features[name] for name in reversed(features)}
    poses = solve(backwards, views)
    assert poses.names == tuple(reversed(truth))
    assert relative_pose_errors(cameras(poses), truth).median_pair_deg < 0.06


def test_no_image_need_see_the_first() -> None:
    """A corridor: each camera shares pairs with the two before it alone."""
    rng = np.random.default_rng(12)
    truth = {
        f"{n}.jpg": Rigid3.from_center(random_rotation(rng), [0.5 * n - 1.25, 0.1 * (n % 2), 0.12 * (n % 3)])
        for n in range(6)
    }
    features = synthetic_features(rng, truth, points=700)
    names = list(truth)
    views = synthetic_two_views(rng, features)
    near = {(a, b): view for (a, b), view in views.items() if abs(names.index(a) - names.index(b)) <= 2}
    poses = refine_poses(solve(features, near))
    assert poses.names == tuple(names)
    assert relative_pose_errors(cameras(poses), truth).median_pair_deg < 0.06


def test_an_image_without_pairs_is_rejected_with_its_best_partner(capture: Capture) -> None:
    _, features, views = capture
    cut = {
        pair: TwoView.failed("23 matches, 60 needed", candidates=23) if "3.jpg" in pair else view
        for pair, view in views.items()
    }
    poses = solve(features, cut)
    assert poses.names == ("0.jpg", "1.jpg", "2.jpg", "4.jpg")
    assert "best partner" in poses.rejected["3.jpg"]
    assert "23 matches, 60 needed" in poses.rejected["3.jpg"]


def test_an_image_with_a_wrong_pair_alone_is_rejected(capture: Capture) -> None:
    """Its only pair is false (a repeated room, say): the points known from the others speak against it."""
    _, features, views = capture
    rng = np.random.default_rng(13)
    false = views["2.jpg", "3.jpg"]
    kept = {pair: view for pair, view in views.items() if "3.jpg" not in pair}
    shuffled = np.stack([false.matches_idx[:, 0], rng.permutation(false.matches_idx[:, 1])], axis=1)
    kept["2.jpg", "3.jpg"] = replace(false, matches_idx=shuffled.astype(np.int32))
    poses = solve(features, kept)
    assert poses.names == ("0.jpg", "1.jpg", "2.jpg", "4.jpg")
    assert set(poses.rejected) == {"3.jpg"}
    assert "no pair with a registered image shares enough points" in poses.rejected["3.jpg"]


def test_an_image_is_placed_right_by_a_third_of_the_known_points(capture: Capture) -> None:
    """Two thirds of its matches are false, but the others agree far more than chance."""
    truth, features, views = capture
    rng = np.random.default_rng(24)
    kept = {pair: view for pair, view in views.items() if "3.jpg" not in pair}
    view = views["2.jpg", "3.jpg"]
    matches = view.matches_idx.copy()
    wrong = rng.permutation(len(matches))[: int(0.68 * len(matches))]
    matches[wrong, 1] = rng.permutation(matches[wrong, 1])
    kept["2.jpg", "3.jpg"] = replace(view, matches_idx=matches)
    poses = solve(features, kept)
    assert poses.names == tuple(truth)
    placed = {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
    turn = placed["3.jpg"].rotation @ placed["2.jpg"].rotation.T
    assert float(geodesic_angle(turn, truth["3.jpg"].rotation @ truth["2.jpg"].rotation.T)) < np.deg2rad(0.5)


def test_every_group_is_solved_in_its_own_frame() -> None:
    rng = np.random.default_rng(14)
    truth = random_poses(rng, 5)
    features = synthetic_features(rng, truth)
    views = synthetic_two_views(rng, features)
    first = {"0.jpg", "1.jpg"}
    apart = {pair: view for pair, view in views.items() if (pair[0] in first) == (pair[1] in first)}
    poses = solve(features, apart)
    assert poses.names == tuple(truth)
    assert poses.rejected == {}
    np.testing.assert_array_equal(poses.group_idx, [1, 1, 0, 0, 0])
    for group in split_groups(poses):
        np.testing.assert_array_equal(group.rotations[0], np.eye(3))
        assert np.linalg.norm(group.centers[1]) == pytest.approx(1.0)
        known = {name: truth[name] for name in group.names}
        assert relative_pose_errors(cameras(group), known).median_pair_deg < 0.15


def test_two_images_are_a_capture(capture: Capture) -> None:
    truth, features, views = capture
    two = {name: features[name] for name in ("0.jpg", "1.jpg")}
    poses = refine_poses(solve(two, {("0.jpg", "1.jpg"): views["0.jpg", "1.jpg"]}))
    assert len(poses.names) == 2
    errors = relative_pose_errors(cameras(poses), {name: truth[name] for name in poses.names})
    assert errors.median_pair_deg < 0.15


@pytest.mark.parametrize("count", [0, 1, 3])
def test_nothing_to_register_is_no_exception(count: int) -> None:
    rng = np.random.default_rng(15)
    features = synthetic_features(rng, random_poses(rng, count))
    names = list(features)
    views = {(a, b): TwoView.failed("no overlap") for i, a in enumerate(names) for b in names[i + 1 :]}
    poses = solve(features, views)
    poses.check()
    assert poses.names == ()
    assert set(poses.rejected) == set(names)
    assert all(poses.rejected.values())
    refine_poses(poses).check()


def bundle_of(rng: np.random.Generator, *, cameras: int = 4, points: int = 60, noise_deg: float = 0.05) -> Bundle:
    poses = list(random_poses(rng, cameras).values())
    world = points_in_box(rng, points)
    seen = rng.random((len(world), cameras)) < 0.8
    seen[:, :2] = True
    point_idx, image_idx = np.nonzero(seen)
    bearings = np.stack([noisy_bearings(rng, pose, world, noise_deg=noise_deg) for pose in poses], axis=1)
    return Bundle(
        rotations=np.array([pose.rotation for pose in poses]),
        centers=np.array([pose.center for pose in poses]),
        points=world,
        point_idx=point_idx.astype(np.int32),
        image_idx=image_idx.astype(np.int32),
        bearings=bearings[point_idx, image_idx],
    )


@pytest.mark.kernel("poses.adjustment.kernels_bundle")
@pytest.mark.parametrize("units_per_m", [0.0, 0.7])
def test_kernel_equals_the_dense_system(units_per_m: float) -> None:
    rng = np.random.default_rng(16)
    bundle = bundle_of(rng, points=15, noise_deg=3.0)
    offsets_m = rng.normal(0, 0.3, bundle.bearings.shape)
    bundle = replace(bundle, offsets_m=offsets_m, units_per_m=units_per_m)
    bases = tangent_basis(bundle.bearings)
    weights = rng.uniform(0.1, 1.0, size=len(bundle.bearings))
    starts = np.searchsorted(bundle.point_idx, np.arange(len(bundle.points) + 1))
    width = 6 * (camera_span(starts, bundle.image_idx) + 1)
    band, gradient, diagonal, *_ = reduced_system(
        bundle.rotations,
        bundle.centers,
        bundle.points,
        starts,
        bundle.image_idx,
        bases,
        bundle.origins,
        weights,
        0.01,
        width,
    )
    lower = dense_from_band(band)
    system = np.tril(lower) + np.tril(lower, -1).T
    expected_system, expected_gradient = reduced_system_dense(bundle, bases, weights, 0.01)
    np.testing.assert_allclose(system, expected_system, atol=1e-6 * np.abs(expected_system).max())
    np.testing.assert_allclose(gradient, expected_gradient, atol=1e-6 * np.abs(expected_gradient).max())
    assert np.all(diagonal >= np.diag(system) - 1e-12)


@pytest.mark.kernel("poses.adjustment.kernels_bundle")
def test_compiled_errors_are_those_of_the_bundle() -> None:
    rng = np.random.default_rng(21)
    bundle = bundle_of(rng, points=15, noise_deg=3.0)
    bundle = replace(bundle, offsets_m=rng.normal(0, 0.3, bundle.bearings.shape), units_per_m=0.7)
    found = ray_errors(
        bundle.rotations,
        bundle.centers,
        bundle.points,
        bundle.point_idx,
        bundle.image_idx,
        bundle.bearings,
        bundle.origins,
    )
    np.testing.assert_allclose(found, bundle.errors_rad(), atol=1e-12)


@pytest.mark.kernel("poses.adjustment.kernels_bundle")
def test_points_move_by_back_substitution() -> None:
    rng = np.random.default_rng(22)
    bundle = bundle_of(rng, points=15, noise_deg=3.0)
    system = reduced_cameras(bundle, np.ones(len(bundle.bearings)), damping=0.01)
    steps = rng.normal(0, 0.01, (len(bundle.centers), 6))
    coupled = np.einsum("tij,ti->tj", system.couplings, steps[bundle.image_idx])
    right = system.point_gradients.copy()
    np.add.at(right, bundle.point_idx, coupled)
    expected = bundle.points - np.einsum("pij,pj->pi", system.inverses, right)
    starts = np.searchsorted(bundle.point_idx, np.arange(len(bundle.points) + 1))
    found = moved_points(
        bundle.points, starts, bundle.image_idx, system.couplings, system.inverses, system.point_gradients, steps
    )
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_adjustment_finds_back_from_a_disturbed_start(loss: Literal["huber", "cauchy"]) -> None:
    rng = np.random.default_rng(17)
    true = bundle_of(rng, noise_deg=0.0)
    turns = rotation_from_rotvec(0.01 * rng.normal(size=(4, 3)))
    turns[0] = np.eye(3)
    moves = 0.01 * rng.normal(size=(4, 3))
    moves[0] = 0
    start = replace(
        true,
        rotations=turns @ true.rotations,
        centers=true.centers + moves,
        points=true.points + 0.02 * rng.normal(size=true.points.shape),
    )
    found = adjust_bundle(start, RobustLoss(loss, 0.01), max_iterations=100)
    assert np.rad2deg(found.errors_rad().max()) < 1e-3
    np.testing.assert_array_equal(found.rotations[0], true.rotations[0])
    np.testing.assert_array_equal(found.centers[0], true.centers[0])
    assert np.rad2deg(geodesic_angle(found.rotations, true.rotations).max()) < 1e-3


def test_a_camera_without_observations_stays() -> None:
    rng = np.random.default_rng(18)
    bundle = bundle_of(rng)
    kept = bundle.image_idx != 3
    lonely = replace(
        bundle, point_idx=bundle.point_idx[kept], image_idx=bundle.image_idx[kept], bearings=bundle.bearings[kept]
    )
    found = adjust_bundle(lonely, RobustLoss("cauchy", 0.002))
    np.testing.assert_allclose(found.centers[3], bundle.centers[3], atol=1e-12)
    assert np.isfinite(found.points).all()


def test_adjustment_never_raises_the_cost() -> None:
    bundle = bundle_of(np.random.default_rng(19), noise_deg=1.0)
    found = adjust_bundle(bundle, RobustLoss("cauchy", 0.01))
    costs = [RobustLoss("cauchy", 0.01).cost(b.errors_rad()) for b in (found, bundle)]
    assert costs[0] < costs[1]


def test_adjustment_wants_observations_sorted_by_point() -> None:
    bundle = bundle_of(np.random.default_rng(20))
    with pytest.raises(UsageError, match="sorted by point"):
        adjust_bundle(replace(bundle, point_idx=bundle.point_idx[::-1].copy()), RobustLoss("huber", 0.01))


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_weights_are_the_derivative_of_the_loss(loss: Literal["huber", "cauchy"]) -> None:
    for error in (0.001, 0.009, 0.02, 0.3):
        h = 1e-7
        above, below = (RobustLoss(loss, 0.01).cost(np.array([error + s * h])) for s in (1, -1))
        weight = RobustLoss(loss, 0.01).weights(np.array([error]))[0]
        assert (above - below) / (2 * h) == pytest.approx(2 * weight * error / 0.01**2, rel=1e-4)


def test_metric_poses_keep_their_place_and_scale(capture: Capture) -> None:
    truth, features, views = capture
    there = Similarity3(7.0, random_rotation(np.random.default_rng(21)), np.array([10.0, -4.0, 2.0]))
    known = {name: there.move_camera(pose) for name, pose in truth.items()}
    given = Poses.without_points(known, frame="site", scale="metres", metric=True)
    refined = refine_poses(triangulate_tracks(given, features, views))
    assert (refined.frame, refined.scale, refined.metric) == ("site", "metres", True)
    assert np.linalg.norm(refined.centers - given.centers, axis=1).max() < 7.0 * 0.003
    assert len(refined.points_in_world) > 300


def test_poses_without_points_come_back_as_they_are(capture: Capture) -> None:
    truth, *_ = capture
    given = Poses.without_points(truth, frame="x", scale="x", metric=False)
    refined = refine_poses(given)
    np.testing.assert_allclose(refined.rotations, given.rotations, atol=1e-12)
    np.testing.assert_allclose(refined.translations, given.translations, atol=1e-9)


def test_refinement_refuses_senseless_limits(capture: Capture) -> None:
    truth, *_ = capture
    with pytest.raises(UsageError, match="positive"):
        refine_poses(Poses.without_points(truth, frame="x", scale="x", metric=False), loss_scale_deg=0.0)


def test_a_camera_beside_the_first_is_no_unit_of_length() -> None:
    centers = np.array([[0.0, 0, 0], [0.001, 0, 0], [1.0, 0, 0], [0, 1.2, 0]])
    assert first_neighbour(centers) == 2
    assert first_neighbour(np.zeros((3, 3))) == 0
    assert first_neighbour(np.zeros((0, 3))) == 0


def test_gauge_comes_back_after_any_move(capture: Capture) -> None:
    truth, *_ = capture
    given = Poses.without_points(truth, frame="x", scale="x", metric=True)
    moved = moved_poses(given, Similarity3(2.0, random_rotation(np.random.default_rng(22)), np.ones(3)))
    back = in_gauge_of(moved, given.centers)
    np.testing.assert_allclose(back.centers, given.centers, atol=1e-9)
    np.testing.assert_allclose(back.rotations, given.rotations, atol=1e-9)


def test_resection_finds_the_camera_despite_wrong_points() -> None:
    rng = np.random.default_rng(23)
    pose = Rigid3.from_center(random_rotation(rng), [0.3, -0.2, 0.1])
    points = points_in_box(rng, 200)
    bearings = noisy_bearings(rng, pose, points, noise_deg=0.02)
    bearings[:40] = rng.permutation(bearings[:40])
    start = Rigid3.from_center(rotation_from_rotvec([0.02, -0.01, 0.02]) @ pose.rotation, pose.center + 0.05)
    found = refine_resection(start, points, bearings, scale_rad=0.005, iterations=30)
    assert np.rad2deg(geodesic_angle(found.rotation, pose.rotation)) < 0.01
    assert np.linalg.norm(found.center - pose.center) < 0.001
