"""Images of small groups are matched with images that a selector of pairs did not choose."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.poses.joining.further_pairs import further_pairs
from pano_mvs.geometry import geodesic_angle
from pano_mvs.scene import TwoView
from tests.algorithms.poses.joining.two_rooms import room_features, room_poses, verified_inside

NAMES = ("a1", "a2", "b1", "b2")
ALIKE = np.array([[0, 9, 2, 1], [9, 0, 1, 2], [2, 1, 0, 9], [1, 2, 9, 0]], float)


def test_the_most_similar_images_of_other_groups_are_matched() -> None:
    poses = room_poses()
    features = room_features(poses, door=120)
    inside = {pair: view for pair, view in verified_inside(features).items() if view}
    assert set(inside) == {("a1", "a2"), ("b1", "b2")}
    found = further_pairs(features, inside, ALIKE, candidates=1, rng=np.random.default_rng(0))
    assert set(found) == {("a1", "b1"), ("a2", "b2")}
    for (a, b), view in found.items():
        relative = poses[b] @ poses[a].inverse()
        assert np.rad2deg(geodesic_angle(view.rotation, relative.rotation)) < 0.5
    assert further_pairs(features, inside, ALIKE, candidates=0, rng=np.random.default_rng(0)) == {}


def test_pairs_that_were_compared_are_not_matched_again() -> None:
    features = room_features(room_poses(), door=120)
    inside = verified_inside(features)
    assert not inside["a1", "b1"]
    assert further_pairs(features, inside, ALIKE, candidates=3, rng=np.random.default_rng(0)) == {}


def test_a_capture_in_one_group_gets_no_further_pairs() -> None:
    features = room_features(room_poses(), door=120)
    verified = TwoView(np.zeros((1, 2), np.int32), np.eye(3), np.array([1.0, 0, 0]), np.zeros(1, np.float32), "general")
    chain = {("a1", "a2"): verified, ("a2", "b1"): verified, ("b1", "b2"): verified}
    assert further_pairs(features, chain, ALIKE, candidates=3, rng=np.random.default_rng(0)) == {}
