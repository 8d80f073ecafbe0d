"""Squeezed tiles add true matches on a wall that one image sees obliquely, and images are read only as needed."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.joining import pair_matcher
from pano_mvs.algorithms.poses.joining.bridges import find_bridges
from pano_mvs.algorithms.poses.joining.pair_matcher import PairMatcher
from pano_mvs.geometry import Rigid3, angle_between
from pano_mvs.scene import Features
from pano_mvs.testing.paint import WHITE
from pano_mvs.testing.room import Room, render
from pano_mvs.testing.surfaces import Quad
from tests.algorithms.poses.joining.two_rooms import room_features, room_poses, verified_inside

SIZE = (192, 384)
EVERYWHERE = np.ones(SIZE, np.bool_)
WALL_Z = 2.0
# The second camera is in front of the part of the wall that the first one sees at 60° from its normal.
POSES = {"a": Rigid3.identity(), "b": Rigid3.from_center(np.eye(3), np.array([4.0, 0.0, -1.0]))}
Image = NDArray[np.uint8]


def _images(seed: int) -> dict[str, Image]:
    """Return a painted wall in front of the first camera, as both cameras see it."""
    wall = Quad((-1.0, -1.6, WALL_Z), (8.0, 0.0, 0.0), (0.0, 3.2, 0.0), WHITE)
    room = Room((wall,), "outdoor", seed, lamp=(3.0, -1.0, -3.0))
    return {name: render(room, pose, SIZE, supersample=1)[0] for name, pose in POSES.items()}


@pytest.fixture(scope="module")
def captures() -> list[tuple[dict[str, Image], dict[str, Features]]]:
    found = []
    for seed in (3, 4, 5):
        images = _images(seed)
        found.append((images, {name: extract_sift(image, EVERYWHERE) for name, image in images.items()}))
    return found


def _true(features: dict[str, Features], matches: NDArray[np.int32]) -> NDArray[np.bool_]:
    rays = features["a"].bearings[matches[:, 0]]
    seen = POSES["b"].apply(rays * (WALL_Z / rays[:, 2:]))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    return np.asarray(angle_between(seen, features["b"].bearings[matches[:, 1]]) < np.deg2rad(1.0))


def test_squeezed_tiles_add_true_matches_on_an_oblique_wall(
    captures: list[tuple[dict[str, Image], dict[str, Features]]],
) -> None:
    totals = np.zeros((2, 2), int)
    for images, features in captures:
        for row, matcher in enumerate(
            (PairMatcher(features), PairMatcher(features, lambda name, images=images: (images[name], EVERYWHERE)))  # type: ignore[misc]
        ):
            matches = matcher.matches((0, 1), 0.8)
            totals[row] += len(matches), _true(features, matches).sum()
    (plain, plain_true), (squeezed, squeezed_true) = totals
    assert squeezed_true > 1.3 * plain_true
    assert squeezed_true / squeezed > 0.9 * plain_true / plain


def test_without_images_the_matches_are_those_of_the_key_points(
    captures: list[tuple[dict[str, Image], dict[str, Features]]],
) -> None:
    features = captures[0][1]
    expected = match_features(features["a"], features["b"], ratio=0.88)
    matcher = PairMatcher(features)
    np.testing.assert_array_equal(matcher.matches((0, 1), 0.88), expected)
    np.testing.assert_array_equal(matcher.matches((1, 0), 0.88), expected[:, ::-1])


def test_key_points_that_are_not_of_sift_are_matched_as_they_are() -> None:
    images = _images(3)
    features = {name: extract_orb(image, EVERYWHERE) for name, image in images.items()}
    matcher = PairMatcher(features, lambda name: pytest.fail(f"{name} was read"))
    np.testing.assert_array_equal(matcher.matches((0, 1), 0.8), match_features(features["a"], features["b"], ratio=0.8))


@pytest.mark.parametrize(("kept", "reads"), [(256, 1), (1, 2)])
def test_each_image_is_read_once_unless_there_are_many(
    captures: list[tuple[dict[str, Image], dict[str, Features]]],
    monkeypatch: pytest.MonkeyPatch,
    kept: int,
    reads: int,
) -> None:
    images, features = captures[0]
    three = {"a": features["a"], "b": features["b"], "c": features["a"]}
    read: Counter[str] = Counter()

    def load(name: str) -> tuple[Image, NDArray[np.bool_]]:
        read[name] += 1
        return images["b" if name == "b" else "a"], EVERYWHERE

    monkeypatch.setattr(pair_matcher, "KEPT_IMAGES", kept)
    matcher = PairMatcher(three, load)
    for pair in ((0, 1), (1, 2), (2, 0), (1, 0)):
        for ratio in (0.8, 0.88):
            matcher.matches(pair, ratio)
    assert max(read.values()) == reads
    # Kept or described again, the matches are the same.
    again = PairMatcher(three, load)
    for pair in ((2, 1), (0, 1)):
        np.testing.assert_array_equal(matcher.matches(pair, 0.8), again.matches(pair, 0.8))


def test_no_image_is_read_if_the_pairs_connect_all() -> None:
    features = {name: one for name, one in room_features(room_poses(), door=60).items() if name[0] == "a"}
    found = find_bridges(
        features,
        verified_inside(features),
        rng=np.random.default_rng(0),
        load=lambda name: pytest.fail(f"{name} was read"),
    )
    assert found.groups == (1, 1)
