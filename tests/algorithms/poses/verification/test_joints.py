"""Parts of a model that few points connect, and what they see through each other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.pair_evidence import geometries_of
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel, pairs_of
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation
from pano_mvs.algorithms.poses.verification.joints import linked_parts, measured_joints
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


def two_parts(between: Mapping[Edge, int], *, second: Mapping[int, Rigid3] | None = None) -> PlacedModel:
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
        view = view_of(cameras[b] @ cameras[a].inverse(), matches)
        geometries[a, b] = geometries_of(view, *(features[f"{idx}.png"].bearings for idx in (a, b)))
    return PlacedModel(Pairs(features, geometries), cameras, dict.fromkeys(geometries, 0))


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


def test_a_true_joint_is_not_contradicted(confirmation: Confirmation) -> None:
    (joint,) = measured_joints(two_parts({(1, 2): 40}), confirmation)
    assert joint.parts == ((0, 1), (2, 3))
    assert joint.matches == 40
    assert joint.contradicting < 0.1


def test_parts_that_look_through_each_other_contradict_each_other(confirmation: Confirmation) -> None:
    (joint,) = measured_joints(two_parts({(1, 2): 40}, second=moved_part(90.0, (0.0, 0.0, 0.0))), confirmation)
    assert joint.contradicting > 0.1


def test_a_part_of_one_camera_is_not_compared(confirmation: Confirmation) -> None:
    model = two_parts({(1, 2): 40})
    model.remove(3)
    (joint,) = measured_joints(model, confirmation)
    assert joint.parts == ((0, 1), (2,))
    assert np.isnan(joint.contradicting)


def test_pairs_that_were_compared_are_known() -> None:
    rays = np.random.default_rng(3).normal(size=(KEYPOINTS, 3))
    features = {name: features_from_bearings(rays) for name in "abc"}
    two_views = {("a", "b"): TwoView.failed("nothing"), ("c", "b"): TwoView.failed("nothing")}
    assert set(pairs_of(features, two_views).compared or {}) == {(0, 1), (1, 2)}
