from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from pano_mvs.algorithms.poses.adjustment.tracks import (
    Tracks,
    build_tracks,
    triangulate_observations,
    triangulate_tracks,
)
from pano_mvs.algorithms.poses.placement.pair_evidence import estimate_scale
from pano_mvs.algorithms.poses.placement.view_graph import connected_groups, consistent_edges
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Features, Poses, TwoView
from tests.algorithms.poses.synthetic_capture import (
    features_from_bearings,
    points_in_box,
    random_poses,
    synthetic_features,
    synthetic_two_views,
)
from tests.oracles.poses import triangulate_numpy


def pair(
    matches: ArrayLike,
    residuals: ArrayLike | None = None,
    pose: Rigid3 | None = None,
    geometry: Literal["general", "rotation", "none"] = "general",
) -> TwoView:
    pose = pose or Rigid3(np.eye(3), np.array([1.0, 0, 0]))
    matches = np.array(matches, np.int32).reshape(-1, 2)
    errors = np.zeros(len(matches)) if residuals is None else np.array(residuals)
    direction = pose.translation / np.linalg.norm(pose.translation)
    return TwoView(matches, pose.rotation, direction, errors.astype(np.float32), geometry)


def any_features(count: int) -> Features:
    bearings = np.random.default_rng(count).normal(size=(count, 3))
    return features_from_bearings(bearings / np.linalg.norm(bearings, axis=1, keepdims=True))


def as_sets(tracks: Tracks) -> list[set[tuple[str, int]]]:
    found: list[set[tuple[str, int]]] = [set() for _ in range(tracks.count)]
    for track, image, keypoint in zip(tracks.track_idx, tracks.image_idx, tracks.keypoint_idx, strict=True):
        found[track].add((tracks.names[image], int(keypoint)))
    return found


def test_tracks_join_matches_over_images() -> None:
    features = {name: any_features(5) for name in "abc"}
    tracks = build_tracks(features, {("a", "b"): pair([(0, 1), (2, 2)]), ("b", "c"): pair([(1, 4)])})
    assert as_sets(tracks) == [{("a", 0), ("b", 1), ("c", 4)}, {("a", 2), ("b", 2)}]
    np.testing.assert_array_equal(tracks.bearings[0], features["a"].bearings[0])
    assert np.all(np.diff(tracks.track_idx) >= 0)


def test_a_conflict_is_settled_for_the_better_match() -> None:
    features = {name: any_features(5) for name in "abc"}
    views = {
        ("a", "b"): pair([(0, 0)], [0.001]),
        ("b", "c"): pair([(0, 0)], [0.002]),
        ("a", "c"): pair([(1, 0)], [0.009]),  # would bring a0 and a1 together
    }
    assert as_sets(build_tracks(features, views)) == [{("a", 0), ("b", 0), ("c", 0)}]
    views["a", "c"] = pair([(1, 0)], [0.0001])
    assert as_sets(build_tracks(features, views)) == [{("a", 0), ("b", 0)}, {("a", 1), ("c", 0)}]


def test_pairs_without_general_geometry_join_nothing() -> None:
    features = {name: any_features(3) for name in "ab"}
    views = {("a", "b"): pair([(0, 0)], geometry="rotation")}
    assert build_tracks(features, views).count == 0
    assert build_tracks({}, {}).count == 0


def test_no_track_ever_has_two_key_points_in_one_image() -> None:
    rng = np.random.default_rng(3)
    features = {name: any_features(30) for name in "abcde"}
    names = list(features)
    views = {
        (a, b): pair(rng.integers(30, size=(25, 2)), rng.random(25)) for i, a in enumerate(names) for b in names[:i]
    }
    tracks = build_tracks(features, views)
    assert tracks.count > 10
    seen = tracks.track_idx.astype(int) * 5 + tracks.image_idx
    assert len(np.unique(seen)) == len(seen)
    assert np.bincount(tracks.track_idx).min() >= 2


def known_poses(poses: Mapping[str, Rigid3]) -> Poses:
    return Poses.without_points(poses, frame="given", scale="given", metric=True)


def test_known_poses_get_points_and_do_not_move() -> None:
    rng = np.random.default_rng(4)
    poses = random_poses(rng, 4)
    features = synthetic_features(rng, poses, points=400)
    known = known_poses(poses)
    found = triangulate_tracks(known, features, synthetic_two_views(rng, features))
    found.check()
    assert found.rotations.tobytes() == known.rotations.tobytes()
    assert found.translations.tobytes() == known.translations.tobytes()
    assert (found.frame, found.scale, found.metric) == ("given", "given", True)
    world = points_in_box(np.random.default_rng(99), 1)  # the box alone
    assert len(found.points_in_world) > 250
    assert np.all(np.abs(found.points_in_world) < np.array([3.0, 1.5, 2.5]) + 0.3)
    assert world.shape[1] == 3
    assert np.rad2deg(np.median(found.point_errors_rad)) < 0.06
    assert np.all(found.point_colors_rgb == 128)


def test_triangulation_drops_the_wrong_observation_and_keeps_the_point() -> None:
    rng = np.random.default_rng(5)
    centers = rng.normal(size=(6, 3)) * 0.5
    point = np.array([2.0, -1.0, 3.0])
    rays = point - centers
    rays[4] = rotation_from_rotvec([0, 0.1, 0]) @ rays[4]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = triangulate_observations(
        centers, rays, np.zeros(6, np.int32), count=1, max_error_rad=0.005, min_angle_rad=0.01
    )
    np.testing.assert_allclose(found.points_in_world[0], point, atol=1e-9)
    assert found.used.tolist() == [True, True, True, True, False, True]


def many_tracks(
    rng: np.random.Generator, count: int = 400
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Observations of tracks of 1 to 6 views with noise, wrong rays, far points and cameras in one place."""
    sizes = rng.integers(1, 7, count)
    point_idx = np.repeat(np.arange(count), sizes).astype(np.int32)
    points = rng.normal(size=(count, 3)) * np.where(rng.random(count) < 0.1, 300.0, 4.0)[:, None]
    centers = rng.normal(size=(8, 3))[rng.integers(8, size=len(point_idx))]
    centers[np.isin(point_idx, np.flatnonzero(rng.random(count) < 0.05))] = 0.5
    rays = points[point_idx] - centers
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays += rng.normal(0, 0.002, rays.shape) + rng.normal(0, 0.3, rays.shape) * (rng.random((len(rays), 1)) < 0.15)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return centers, rays, point_idx


@pytest.mark.kernel("poses.adjustment.kernels_points")
def test_triangulation_is_that_of_numpy() -> None:
    rng = np.random.default_rng(31)
    given = many_tracks(rng)
    limits: dict[str, Any] = {"count": 400, "max_error_rad": 0.01, "min_angle_rad": 0.02}
    found, expected = triangulate_observations(*given, **limits), triangulate_numpy(*given, **limits)
    assert 150 < expected.valid.sum() < 350
    assert (expected.valid[given[2]] & ~expected.used).sum() > 0
    np.testing.assert_array_equal(found.valid, expected.valid)
    np.testing.assert_array_equal(found.used, expected.used)
    np.testing.assert_allclose(found.points_in_world, expected.points_in_world, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.errors_rad, expected.errors_rad, atol=1e-7)


@pytest.mark.parametrize("point", [(0, 0, 400.0), (0, 0, -3.0)])
def test_far_points_and_points_behind_are_no_points(point: tuple[int, int, float]) -> None:
    centers = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    rays = np.abs(np.sign(point[2])) * (np.array(point) - centers) * np.sign(point[2])
    rays = np.array([[0.0, 0, 1], [-0.3, 0, 1.0]]) if point[2] < 0 else rays
    rays = rays * (1 if point[2] > 0 else -1)
    if point[2] < 0:  # one ray to the point, the other away from it
        rays = np.array([[0.0, 0, 1.0], [0.3, 0, 1.0]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = triangulate_observations(
        centers, rays, np.zeros(2, np.int32), count=1, max_error_rad=0.005, min_angle_rad=0.01
    )
    assert not found.valid[0]
    assert np.isnan(found.points_in_world).all()
    assert not found.used.any()


@pytest.mark.parametrize("estimator", ["kappa", "log_median", "cauchy"])
def test_scale_survives_outliers(estimator: Literal["kappa", "log_median", "cauchy"]) -> None:
    rng = np.random.default_rng(6)
    ratios = np.concatenate([1.7 * np.exp(0.004 * rng.normal(size=100)), rng.uniform(0.1, 5, size=40)])
    scale = estimate_scale(ratios, np.ones(140), estimator=estimator, kappa=0.01)
    assert scale == pytest.approx(1.7, rel=0.02 if estimator == "kappa" else 0.004)


def test_scale_listens_to_those_who_see_well() -> None:
    rng = np.random.default_rng(7)
    sigma = np.where(np.arange(400) < 200, 0.002, 0.2)
    ratios = 0.6 * np.exp(sigma * rng.normal(size=400))
    errors = [
        abs(np.log(estimate_scale(ratios, w, estimator="cauchy", kappa=0.01) / 0.6)) for w in (sigma**-2, np.ones(400))
    ]
    assert errors[0] < 0.0005
    with pytest.raises(UsageError, match="at least one ratio"):
        estimate_scale(np.zeros(0), np.zeros(0), estimator="cauchy", kappa=0.01)


def view_of(poses: Mapping[str, Rigid3], a: str, b: str, matches: int = 100) -> TwoView:
    return pair(np.tile(np.arange(matches)[:, None], 2), pose=poses[b] @ poses[a].inverse())


def test_the_pair_that_contradicts_the_others_goes() -> None:
    poses = random_poses(np.random.default_rng(8), 4)
    names = tuple(poses)
    views = {(a, b): view_of(poses, a, b) for i, a in enumerate(names) for b in names[i + 1 :]}
    assert len(consistent_edges(names, views)) == 6
    wrong = views[names[0], names[2]]
    turn = rotation_from_rotvec([0, np.deg2rad(20), 0])
    views[names[0], names[2]] = TwoView(
        wrong.matches_idx, turn @ wrong.rotation, wrong.direction, wrong.residuals_rad, "general"
    )
    assert (0, 2) not in consistent_edges(names, views)
    assert len(consistent_edges(names, views)) == 5


def test_edges_are_the_same_whichever_way_a_pair_is_stored() -> None:
    poses = random_poses(np.random.default_rng(9), 2)
    a, b = poses
    there = consistent_edges((a, b), {(a, b): view_of(poses, a, b)})
    back = consistent_edges((a, b), {(b, a): view_of(poses, b, a)})
    for edges in (there, back):
        true = poses[b] @ poses[a].inverse()
        np.testing.assert_allclose(edges[0, 1].rotation, true.rotation, atol=1e-12)
        np.testing.assert_allclose(
            edges[0, 1].direction, true.translation / np.linalg.norm(true.translation), atol=1e-12
        )


def test_groups_are_sorted_by_size() -> None:
    assert connected_groups([(1, 4), (4, 5), (0, 2)], 6) == [[1, 4, 5], [0, 2], [3]]
