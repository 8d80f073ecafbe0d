"""Parts of a model that few points connect are doubtful unless the images confirm how they are connected."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.pair_evidence import Geometry
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel, pairs_of
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation
from pano_mvs.algorithms.poses.verification.joints import JointEvidence, joint_doubts, joint_evidence, linked_parts
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import TwoView
from tests.algorithms.poses.aliased_capture import view_of
from tests.algorithms.poses.synthetic_capture import features_from_bearings
from tests.algorithms.room_pictures import WHOLE, room_capture

POSES, PICTURES = room_capture()
INSIDE, KEYPOINTS = 200, 500
Edge = tuple[int, int]


@pytest.fixture(scope="module")
def confirmation() -> Confirmation:
    return Confirmation(lambda image: (PICTURES[image], WHOLE))


def two_parts(
    between: Mapping[Edge, int],
    *,
    second: Mapping[int, Rigid3] | None = None,
    rivals: bool = False,
    compared: frozenset[Edge] | None = None,
) -> PlacedModel:
    """Return a model of the parts (0, 1) and (2, 3), with so many matches of each pair between them."""
    cameras = dict(enumerate(POSES[:4])) | dict(second or {})
    rays = np.random.default_rng(3).normal(size=(KEYPOINTS, 3))
    features = {f"{idx}.png": features_from_bearings(rays) for idx in cameras}
    geometries = {}
    for a, b in ((0, 1), (2, 3), *between):
        count = between.get((a, b), INSIDE)
        # No key point has a match in its own part and one in the other, so nothing links the parts.
        first = 0 if count == INSIDE else INSIDE + 60 * (2 * a + b)
        matches = np.stack([np.arange(first, first + count) % KEYPOINTS] * 2, axis=1).astype(np.int32)
        geometry = Geometry(view_of(cameras[b] @ cameras[a].inverse(), matches), 1.0, 0.1, 10.0)
        geometries[a, b] = (geometry, geometry) if rivals and count != INSIDE else (geometry,)
    pairs = Pairs(
        features,
        geometries,
        compared=None if compared is None else dict.fromkeys(compared, TwoView.failed("")),
    )
    return PlacedModel(pairs, cameras, dict.fromkeys(geometries, 0))


def moved_part(turn_deg: float, by: tuple[float, float, float]) -> dict[int, Rigid3]:
    """Return the cameras of the second part, turned about their middle and moved."""
    turn = rotation_from_rotvec([0.0, np.deg2rad(turn_deg), 0.0])
    middle = np.mean([POSES[idx].center for idx in (2, 3)], axis=0)
    return {
        idx: Rigid3.from_center(POSES[idx].rotation @ turn.T, turn @ (POSES[idx].center - middle) + middle + by)
        for idx in (2, 3)
    }


def test_pairs_that_share_key_points_are_one_part() -> None:
    model = two_parts({(1, 2): 40})
    assert linked_parts(model) == [[0, 1], [2, 3]]
    linked = two_parts({(1, 2): INSIDE})
    assert linked_parts(linked) == [[0, 1, 2, 3]]


def test_a_true_joint_is_confirmed(confirmation: Confirmation) -> None:
    model = two_parts({(1, 2): 40})
    evidence = joint_evidence(model, confirmation, ([0, 1], [2, 3]))
    assert evidence.confirms
    assert not evidence.contradicts
    assert joint_doubts(model, confirmation) == {}


def test_parts_that_look_through_each_other_make_everything_doubtful(confirmation: Confirmation) -> None:
    model = two_parts({(1, 2): 40}, second=moved_part(90.0, (0.0, 0.0, 0.0)))
    assert joint_evidence(model, confirmation, ([0, 1], [2, 3])).contradicts
    doubts = joint_doubts(model, confirmation)
    assert list(doubts) == [0, 1, 2, 3]
    assert "contradict" in doubts[0]


def test_parts_that_see_the_same_and_match_nothing_contradict_each_other(confirmation: Confirmation) -> None:
    model = two_parts({(1, 2): 1})
    evidence = joint_evidence(model, confirmation, ([0, 1], [2, 3]))
    assert evidence.agreeing_sr > 0.5
    assert evidence.contradicts


def test_parts_that_see_little_in_common_are_confirmed_only_if_hardly_any_of_it_disagrees() -> None:
    """A tenth of what both see is too little for a contradiction if that is a small part of the sphere."""
    assert JointEvidence(agreeing_sr=0.12, contradicting_sr=0.01, density=1.0).confirms
    unclear = JointEvidence(agreeing_sr=0.12, contradicting_sr=0.018, density=1.0)
    assert not unclear.contradicts
    assert not unclear.confirms


def test_images_that_were_not_compared_do_not_contradict_each_other(confirmation: Confirmation) -> None:
    """A walk that came back to a room, with pairs in sequence only, made all cameras doubtful at right poses."""
    model = two_parts({}, compared=frozenset({(0, 1), (2, 3)}))
    evidence = joint_evidence(model, confirmation, ([0, 1], [2, 3]))
    assert evidence.agreeing_sr > 0.5
    assert np.isnan(evidence.density)
    assert not evidence.contradicts
    assert not evidence.confirms
    assert joint_doubts(model, confirmation) == {}
    tried = two_parts({}, compared=frozenset({(0, 1), (2, 3), (1, 2)}))
    assert joint_evidence(tried, confirmation, ([0, 1], [2, 3])).contradicts
    through = two_parts({}, compared=frozenset(), second=moved_part(90.0, (0.0, 0.0, 0.0)))
    assert joint_evidence(through, confirmation, ([0, 1], [2, 3])).contradicts


def test_pairs_that_were_compared_are_known() -> None:
    rays = np.random.default_rng(3).normal(size=(KEYPOINTS, 3))
    features = {name: features_from_bearings(rays) for name in "abc"}
    two_views = {("a", "b"): TwoView.failed("nothing"), ("c", "b"): TwoView.failed("nothing")}
    assert set(pairs_of(features, two_views).compared or {}) == {(0, 1), (1, 2)}


def test_few_common_points_do_not_make_given_poses_doubtful(confirmation: Confirmation) -> None:
    """Poses of a scanner were doubted because few matches connect two rooms; these did not place the cameras."""
    model = two_parts({(1, 2): 40}, rivals=True)
    assert list(joint_doubts(model, confirmation)) == [2, 3]
    assert joint_doubts(model, confirmation, given=True) == {}
    through = two_parts({(1, 2): 40}, second=moved_part(90.0, (0.0, 0.0, 0.0)))
    assert list(joint_doubts(through, confirmation, given=True)) == [0, 1, 2, 3]


def test_a_joint_with_another_geometry_is_doubtful(confirmation: Confirmation) -> None:
    doubts = joint_doubts(two_parts({(1, 2): 40}, rivals=True), confirmation)
    assert list(doubts) == [2, 3]
    assert "few points connect 2.png, 3.png" in doubts[2]
