"""Pairs of a walk that join places far apart along the path are found; true loop closures are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.poses.loop_closures import find_false_closures
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, TwoView
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings, random_rotation
from tests.algorithms.poses.synthetic_path import PathCapture, window_matches

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
