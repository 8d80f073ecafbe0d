"""Captures of many panoramas: the quick ways equal the plain ones, walks do not drift, and sureness is true.

Pairs of a walk that join places far apart along the path are found; true loop closures are not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, RobustLoss, adjust_bundle
from pano_mvs.algorithms.poses.adjustment.camera_system import (
    camera_order,
    camera_solver,
    camera_span,
    dense_from_band,
    held,
)
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.frame.gauge import normalised_poses
from pano_mvs.algorithms.poses.loop_closures import find_false_closures
from pano_mvs.algorithms.poses.placement.view_graph import consistent_edges
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.geometry import Rigid3, geodesic_angle, rotation_from_rotvec, similarity_from_points
from pano_mvs.scene import Features, Poses, TwoView
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings, random_rotation
from tests.algorithms.poses.synthetic_path import PathCapture, path_capture, path_two_views, window_matches
from tests.known import known


def solve(capture: PathCapture, views: Mapping[tuple[str, str], TwoView]) -> Poses:
    return solve_scaled_translation(capture.features, views, rng=np.random.default_rng(0))


def drift(poses: Poses, capture: PathCapture) -> float:
    """Distance of the last camera from its place, relative to the path, all cameras laid over the truth."""
    truth = np.array([capture.poses[name].center for name in poses.names])
    laid = similarity_from_points(poses.centers, truth).apply(poses.centers)
    return float(np.linalg.norm(laid - truth, axis=1)[-1] / capture.length)


@pytest.mark.parametrize("count", [20, pytest.param(40, marks=pytest.mark.slow)])
def test_a_walk_is_registered_whole_and_does_not_drift(count: int) -> None:
    rng = np.random.default_rng(5)
    capture = path_capture(rng, count, keypoints=150)
    poses = refine_poses(solve(capture, path_two_views(rng, capture)))
    assert poses.names == tuple(capture.poses)
    assert drift(poses, capture) < 0.002


@pytest.mark.slow
def test_deviations_are_those_of_many_draws() -> None:
    """Errors of centres and rotations, divided by their standard deviations, have a mean square of one."""
    centers, rotations = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        capture = path_capture(rng, 10, keypoints=120)
        poses = refine_poses(solve(capture, path_two_views(rng, capture, window=3)))
        poses.check()
        truth = normalised_poses(Poses.without_points(capture.poses, frame="x", scale="x", metric=False))
        assert poses.center_stds is not None
        assert poses.rotation_stds_rad is not None
        assert poses.center_stds[0] == poses.rotation_stds_rad[0] == 0
        centers.append(np.linalg.norm(poses.centers - truth.centers, axis=1)[1:] / poses.center_stds[1:])
        rotations.append(geodesic_angle(poses.rotations, truth.rotations)[1:] / poses.rotation_stds_rad[1:])
        assert np.all(np.diff(poses.center_stds[1:]) > 0)  # the farther, the less sure
    for relative in (centers, rotations):
        assert 0.6 < np.sqrt(np.mean(np.concatenate(relative) ** 2)) < 1.6


def test_deviations_grow_with_the_unit_of_length() -> None:
    rng = np.random.default_rng(6)
    capture = path_capture(rng, 4, keypoints=120)
    poses = refine_poses(solve(capture, path_two_views(rng, capture)))
    stretched = replace(poses, translations=5 * poses.translations, points_in_world=5 * poses.points_in_world)
    again = refine_poses(stretched)
    np.testing.assert_allclose(known(again.center_stds), 5 * known(poses.center_stds), rtol=0.02)
    np.testing.assert_allclose(known(again.rotation_stds_rad), known(poses.rotation_stds_rad), rtol=0.02)


def walk_bundle(rng: np.random.Generator, cameras: int, *, reach: int, shuffled: bool) -> Bundle:
    """Cameras along a line that share points with those near them."""
    centers = np.stack([np.arange(cameras, dtype=float), np.zeros(cameras), np.zeros(cameras)], axis=1)
    rotations = np.array([random_rotation(rng) for _ in range(cameras)])
    seen = [
        (rng.uniform([start, 1, -2], [start + reach, 5, 2]), start + k)
        for start in range(cameras - reach)
        for _ in range(12)
        for k in [np.arange(reach + 1)]
    ]
    points = np.array([point for point, _ in seen])
    point_idx = np.repeat(np.arange(len(points)), reach + 1).astype(np.int32)
    image_idx = np.concatenate([images for _, images in seen]).astype(np.int32)
    if shuffled:
        place = rng.permutation(cameras)
        image_idx, centers, rotations = (
            place[image_idx].astype(np.int32),
            *(a[np.argsort(place)] for a in (centers, rotations)),
        )
    rays = np.einsum("tij,tj->ti", rotations[image_idx], points[point_idx] - centers[image_idx])
    bearings = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return Bundle(rotations, centers, points, point_idx, image_idx, bearings)


@pytest.mark.parametrize("shuffled", [True, False])
def test_cameras_of_a_walk_stand_in_its_order_whatever_their_numbers(shuffled: bool) -> None:
    bundle = walk_bundle(np.random.default_rng(7), 40, reach=2, shuffled=shuffled)
    order = camera_order(bundle.point_idx, bundle.image_idx, 40)
    np.testing.assert_array_equal(np.sort(order), np.arange(40))
    starts = np.searchsorted(bundle.point_idx, np.arange(len(bundle.points) + 1))
    assert camera_span(starts, np.argsort(order)[bundle.image_idx].astype(np.int32)) <= 3


def test_adjustment_does_not_depend_on_the_numbers_of_the_cameras() -> None:
    rng = np.random.default_rng(8)
    bundle = walk_bundle(rng, 30, reach=3, shuffled=False)
    turns = rotation_from_rotvec(0.005 * rng.normal(size=(30, 3)))
    turns[4] = np.eye(3)
    bent = replace(
        bundle, rotations=turns @ bundle.rotations, points=bundle.points + 0.02 * rng.normal(size=bundle.points.shape)
    )
    place = rng.permutation(30)
    order = np.argsort(place)
    shuffled = replace(
        bent,
        rotations=bent.rotations[order],
        centers=bent.centers[order],
        image_idx=place[bent.image_idx].astype(np.int32),
    )
    plain = adjust_bundle(bent, RobustLoss("cauchy", 0.01), fixed_camera=4)
    other = adjust_bundle(shuffled, RobustLoss("cauchy", 0.01), fixed_camera=int(place[4]))
    np.testing.assert_allclose(other.centers[place], plain.centers, atol=1e-5)
    np.testing.assert_array_equal(plain.rotations[4], bundle.rotations[4])
    assert np.rad2deg(plain.errors_rad().max()) < 1e-3


@pytest.mark.parametrize("width", [6, 12, 36, 60])
def test_band_equals_the_dense_solution(width: int) -> None:
    rng = np.random.default_rng(9)
    lower = np.tril(rng.normal(size=(60, 60)))
    lower[np.subtract.outer(np.arange(60), np.arange(60)) >= width] = 0
    whole = lower + np.tril(lower, -1).T + 30 * np.eye(60)
    band = np.zeros((60, width))
    for column in range(60):
        entries = whole[column : column + width, column]
        band[column, : len(entries)] = entries
    np.testing.assert_array_equal(dense_from_band(band), np.tril(whole))
    right = rng.normal(size=60)
    band, right = held(band, right, 3)
    free = np.r_[0:18, 24:60]
    expected = np.zeros(60)
    expected[free] = np.linalg.solve(whole[np.ix_(free, free)], right[free])
    np.testing.assert_allclose(camera_solver(band)(right), expected, atol=1e-12)


def edges_one_by_one(
    names: Sequence[str], views: Mapping[tuple[str, str], TwoView], max_loop_deg: float = 3.0
) -> set[tuple[str, str]]:
    """The plain rule: look at all triangles again after every pair that goes."""
    left = dict(views)
    while True:
        share: dict[tuple[str, str], list[bool]] = {}
        for i, a in enumerate(names):
            for j, b in enumerate(names[i + 1 :], i + 1):
                for c in names[j + 1 :]:
                    sides = (a, b), (b, c), (a, c)
                    if all(side in left for side in sides):
                        loop = left[b, c].rotation @ left[a, b].rotation
                        bad = bool(np.rad2deg(geodesic_angle(loop, left[a, c].rotation)) >= max_loop_deg)
                        for side in sides:
                            share.setdefault(side, []).append(bad)
        worst = max(
            (side for side, bads in share.items() if any(bads)),
            key=lambda s: (np.mean(share[s]), -len(left[s]), s),
            default=None,
        )
        if worst is None:
            return set(left)
        del left[worst]


@pytest.mark.parametrize("seed", range(3))
def test_contradictions_are_settled_as_by_the_plain_rule(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = tuple(f"{n}" for n in range(9))
    truth = {name: random_rotation(rng) for name in names}
    views = {}
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            if rng.random() < 0.9:
                rotation = truth[b] @ truth[a].T if rng.random() < 0.7 else random_rotation(rng)
                matches = np.zeros((int(rng.integers(20, 24)), 2), np.int32)
                views[a, b] = TwoView(
                    matches, rotation, np.array([0.0, 0, 1]), np.zeros(len(matches), np.float32), "general"
                )
    kept = {(names[a], names[b]) for a, b in consistent_edges(names, views)}
    assert kept == edges_one_by_one(names, views)
    assert len(kept) < len(views)


@pytest.mark.slow
def test_the_same_bytes_for_a_walk_again() -> None:
    rng = np.random.default_rng(10)
    capture = path_capture(rng, 8, keypoints=100)
    views = path_two_views(rng, capture)
    first, second = (refine_poses(solve(capture, views)) for _ in range(2))
    assert first.translations.tobytes() == second.translations.tobytes()
    assert known(first.center_stds).tobytes() == known(second.center_stds).tobytes()


def test_cameras_that_see_nothing_have_no_deviation() -> None:
    rng = np.random.default_rng(11)
    capture = path_capture(rng, 4, keypoints=100)
    poses = solve(capture, path_two_views(rng, capture))
    cameras = {name: poses.cam_from_world(n) for n, name in enumerate(poses.names)}
    cameras["away.jpg"] = Rigid3.from_center(np.eye(3), [9.0, 0, 0])
    lonely = Poses.without_points(cameras, frame="x", scale="x", metric=False)
    lonely = replace(
        lonely,
        points_in_world=poses.points_in_world,
        point_colors_rgb=poses.point_colors_rgb,
        point_errors_rad=poses.point_errors_rad,
        track_point_idx=poses.track_point_idx,
        track_image_idx=poses.track_image_idx,
        track_bearings=poses.track_bearings,
    )
    refined = refine_poses(lonely)
    refined.check()
    assert refined.center_stds is not None
    np.testing.assert_array_equal(np.isnan(refined.center_stds), [False, False, False, False, True])


COUNT, RADIUS = 26, 3.0
Views = dict[tuple[str, str], TwoView]


@pytest.fixture(scope="module")
def loop() -> tuple[PathCapture, Views]:
    """A closed walk of 26 cameras on a circle, the pairs in sequence, and the pair that closes the loop."""
    rng = np.random.default_rng(4)
    angles = 2 * np.pi * np.arange(COUNT) / COUNT
    centers = RADIUS * np.stack([np.sin(angles), np.zeros(COUNT), np.cos(angles)], axis=1)
    directions = rng.uniform(-1, 1, (1200, 3))
    directions /= np.abs(directions).max(axis=1, keepdims=True)
    points = centers[rng.integers(COUNT, size=1200)] + 1.3 * directions
    poses, features, seen_by = {}, {}, {}
    for idx, center in enumerate(centers):
        pose = Rigid3.from_center(random_rotation(rng), center)
        away = np.linalg.norm(points - center, axis=1)
        seen = rng.permutation(np.flatnonzero((away > 0.6) & (away < 2.5)))[:160]
        name = f"{idx:02d}.jpg"
        poses[name], seen_by[name] = pose, seen
        features[name] = features_from_bearings(noisy_bearings(rng, pose, points[seen], noise_deg=0.03))
    capture = PathCapture(poses, features, seen_by)
    names = list(poses)
    pairs = [(a, a + step) for a in range(COUNT) for step in (1, 2) if a + step < COUNT]
    return capture, {
        (names[a], names[b]): verify_pair(
            features[names[a]], features[names[b]], window_matches(rng, capture, names[a], names[b]), rng=rng
        )
        for a, b in [*pairs, (0, COUNT - 1)]
    }


def look_alike(capture: PathCapture, views: Views, first: str, second: str) -> Views:
    """Return the pairs with one that matches points of two places, as verified matches of rooms that look the same."""
    count = min(len(capture.features[first]), len(capture.features[second]))
    matches = np.stack([np.arange(count), np.arange(count)], axis=1).astype(np.int32)
    template = views["00.jpg", "01.jpg"]
    return views | {(first, second): replace(template, matches_idx=matches, residuals_rad=np.zeros(count, np.float32))}


@pytest.mark.slow
def test_a_pair_of_places_that_look_alike_is_found(loop: tuple[PathCapture, Views]) -> None:
    capture, views = loop
    (found,) = find_false_closures(capture.features, look_alike(capture, views, "01.jpg", "14.jpg"))
    assert found.pair == ("01.jpg", "14.jpg")
    assert found.steps == pytest.approx(2 * RADIUS / (2 * np.pi * RADIUS / COUNT), rel=0.3)


def test_a_true_loop_closure_is_not(loop: tuple[PathCapture, Views]) -> None:
    capture, views = loop
    assert ("00.jpg", f"{COUNT - 1}.jpg") in views
    assert find_false_closures(capture.features, views) == []


def test_captures_that_are_no_walk_are_not_tested(loop: tuple[PathCapture, Views]) -> None:
    capture, views = loop
    alike = look_alike(capture, views, "01.jpg", "14.jpg")
    shuffled = [f"{idx:02d}.jpg" for idx in np.random.default_rng(0).permutation(COUNT)]
    disordered: dict[str, Features] = {name: capture.features[name] for name in shuffled}
    assert find_false_closures(disordered, alike) == []
    few = {name: capture.features[name] for name in list(capture.features)[:15]}
    kept = {pair: view for pair, view in alike.items() if pair[0] in few and pair[1] in few}
    assert find_false_closures(few, kept) == []


def test_images_between_which_no_path_leads_are_not_compared(loop: tuple[PathCapture, Views]) -> None:
    capture, views = loop
    broken = {pair: view for pair, view in views.items() if not pair[0] < "08.jpg" <= pair[1]}
    assert find_false_closures(capture.features, look_alike(capture, broken, "01.jpg", "14.jpg")) == []
