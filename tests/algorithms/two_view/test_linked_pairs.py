"""The links of a virtual tour count beside the learned matches of its scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.two_view.learned_pairs import ACCEPTED_ODDS, log_odds_of
from pano_mvs.algorithms.two_view.linked_pairs import judged_by_links
from pano_mvs.algorithms.two_view.verification import pair_marks, verify_pair
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Features, SceneLink, TwoView
from tests.algorithms.poses.synthetic_capture import features_from_bearings

POSE = Rigid3.from_center(rotation_from_rotvec((0.0, 0.7, 0.0)), np.array([2.4, 0.0, 0.4]))
FIRST, SECOND = POSE.center, POSE.translation
"""The directions in which the second camera lies in the first one's frame, and the first one in the second's."""


def azimuth_deg(ray: FloatArray) -> float:
    return float(np.degrees(np.arctan2(ray[0], ray[2])))


def _verified(points: FloatArray) -> tuple[Mapping[str, Features], TwoView]:
    rng = np.random.default_rng(5)
    rays = [one + rng.normal(0, 3e-4, one.shape) for one in (points, POSE.apply(points))]
    first, second = (features_from_bearings(one / np.linalg.norm(one, axis=1, keepdims=True)) for one in rays)
    first, second = (replace(one, learned=len(one)) for one in (first, second))
    idx = np.stack([np.arange(len(points))] * 2, axis=1).astype(np.int32)
    return {"a": first, "b": second}, verify_pair(first, second, idx, rng=np.random.default_rng(0))


def pair() -> tuple[Mapping[str, Features], TwoView, TwoView]:
    """Return the key points of two images, a geometry that matches alone refuse, and it as if they had accepted it."""
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-3, 3, 60), rng.uniform(-1.0, 0.1, 60), rng.uniform(4, 8, 60)])
    features, view = _verified(points)
    assert not view
    best = view.alternatives[0]
    odds = log_odds_of(view.log10_false_alarms, pair_marks(features["a"], features["b"], best))
    assert ACCEPTED_ODDS - 3.0 < odds < ACCEPTED_ODDS
    return features, view, replace(best, log10_false_alarms=view.log10_false_alarms)


def _links(off_deg: float, *, both: bool = True) -> dict[str, list[SceneLink]]:
    there, back = (azimuth_deg(end) + off_deg for end in (FIRST, SECOND))
    return {"a": [SceneLink("b", (there, -25.0))], "b": [SceneLink("a", (back, 5.0))] if both else []}


@pytest.mark.parametrize("off_deg", [0.0, 12.0])
def test_links_in_the_direction_of_the_other_camera_confirm_a_pose(off_deg: float) -> None:
    features, refused, _ = pair()
    judged = judged_by_links({("a", "b"): refused}, features, _links(off_deg))["a", "b"]
    assert judged
    assert judged.log10_false_alarms == pytest.approx(refused.log10_false_alarms, abs=2.0)
    np.testing.assert_allclose(judged.rotation, POSE.rotation, atol=0.01)


def test_links_elsewhere_contradict_it() -> None:
    features, refused, accepted = pair()
    for view in (refused, accepted):
        judged = judged_by_links({("a", "b"): view}, features, _links(90.0))["a", "b"]
        assert not judged
        assert len(judged.alternatives) == 1  # still a hypothesis
        assert "look alike" in judged.reason


def test_a_link_at_the_nadir_says_nothing_of_the_direction() -> None:
    features, refused, _ = pair()
    links = {"a": [SceneLink("b", (azimuth_deg(FIRST), -88.0))], "b": [SceneLink("a", (azimuth_deg(SECOND), 90.0))]}
    assert not judged_by_links({("a", "b"): refused}, features, links)["a", "b"]


def test_pairs_without_links_that_state_directions_stay_as_they_are() -> None:
    features, refused, accepted = pair()
    for links in ({}, {"a": [SceneLink("c", (0.0, 0.0)), SceneLink("b")]}):
        for view in (refused, accepted):
            assert judged_by_links({("a", "b"): view}, features, links)["a", "b"] is view
    plain = {name: replace(one, learned=0) for name, one in features.items()}
    assert judged_by_links({("a", "b"): accepted}, plain, _links(90.0))["a", "b"] is accepted
