"""Doubts follow from the probability by two costs, and say what lowers it most."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.logistic import Model, Term
from pano_mvs.algorithms.poses.verification.belief.coefficients import FITTED
from pano_mvs.algorithms.poses.verification.belief.doubts import (
    is_doubtful,
    is_left_out,
    probability_of,
    reason,
    with_later_evidence,
)
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Poses

BEST = {
    "ratio": 1.2,
    "share": 0.8,
    "wide_share": 0.6,
    "likeness": 0.0,
    "unlike": 0.0,
    "contradicted": 0.0,
    "agreeing": 6.0,
    "pairs_contradicting": 0.3,
    "scale_worst": 0.0,
    "place_rival": 0.0,
    "repeats": 0.0,
}


def test_the_costs_decide() -> None:
    assert [is_doubtful(one) for one in (0.1, 0.83, 0.84, 1.0)] == [True, True, False, False]
    assert not is_doubtful(0.6, miss_cost=1.0)
    assert [is_left_out(one) for one in (0.1, 0.16, 0.17, 0.9)] == [True, True, False, False]
    assert not is_left_out(0.4, miss_cost=0.5), "what is not doubted is not left out"


def test_a_camera_that_everything_supports_is_right() -> None:
    assert FITTED.probability(BEST) > 0.97
    assert FITTED.probability(BEST | {"pairs_contradicting": 0.0}) > 0.99


@pytest.mark.parametrize(
    ("worse", "said"),
    [
        ({"ratio": 0.1, "share": 0.05}, "confirm 5 % of its texture, but its neighbours suggest 50 %"),
        ({"agreeing": 0.0, "place_rival": np.nan}, "only 0 pairs agree with its place"),
        ({"wide_share": 0.0}, "confirm only 0 % of what it sees under more than 30°"),
        ({"likeness": -0.3}, "is correlated by 0.30 less with what other images lead to expect there"),
        ({"unlike": 0.4}, "40 % of what it shows is unlike what other images lead to expect there"),
        ({"contradicted": 0.9, "place_rival": np.nan}, "90 % of the weight of its pairs contradicts its place"),
        ({"scale_worst": 0.05}, "contradict its distances to other cameras by 5.1 %"),
        ({"place_rival": 2.0}, "place it elsewhere with 200 % of the weight"),
        ({"repeats": 1.2}, "the place repeats"),
    ],
)
def test_the_worst_measurements_are_said(worse: dict[str, float], said: str) -> None:
    row = BEST | worse
    assert FITTED.probability(row) < FITTED.probability(BEST)
    assert said in reason(FITTED, row)


def test_no_more_than_two_measurements_are_said_and_what_to_do() -> None:
    terms = {
        name: Term((0.0, 1.0), (loss,), 0.0) for name, loss in (("place_rival", 1.0), ("repeats", 2.0), ("share", 3.0))
    }
    found = reason(Model(1.0, terms), {"place_rival": 0.0, "repeats": 0.0, "share": 0.0})
    assert found.startswith("its pose is right with a probability of 1 %: other images confirm only 0 %")
    assert "the place repeats" in found
    assert "place it elsewhere" not in found
    assert found.endswith("take panoramas closer to one another there, or take panoramas in between")


def test_another_arrangement_is_named_without_a_claim_that_the_images_cannot_decide() -> None:
    found = reason(FITTED, BEST | {"repeats": 1.0}, ambiguity="the block may be elsewhere")
    assert "; the block may be elsewhere" in found
    assert "decided" not in found


def test_what_is_missing_is_said_as_such() -> None:
    found = reason(FITTED, dict.fromkeys(BEST, np.nan))
    assert "nan" not in found


def poses_with(*probabilities: float) -> Poses:
    cameras = {f"{idx}.png": Rigid3.from_center(np.eye(3), np.array([idx, 0.0, 0.0])) for idx in range(3)}
    poses = Poses.without_points(cameras, frame="x", scale="x", metric=False)
    return replace(poses, right_probabilities=np.array(probabilities)) if probabilities else poses


def test_later_evidence_changes_the_probability_and_the_doubt_follows_from_it() -> None:
    """Views that others contradict were doubtful by a rule, whatever else was known of their cameras."""
    poses = poses_with(0.5, 0.9, 0.9999)
    found = with_later_evidence(poses, {"1.png": (0.01, "other views contradict it"), "2.png": (0.01, "and it")})
    assert found.right_probabilities is not None
    np.testing.assert_allclose(found.right_probabilities, [0.5, 0.09 / 1.09, 99.99 / 100.99], rtol=1e-6)
    assert set(found.doubts) == {"1.png"}
    assert found.doubts["1.png"] == "its pose is right with a probability of 8 %: other views contradict it"
    found.check()


def test_a_doubt_states_the_latest_probability_with_all_reasons() -> None:
    poses = poses_with(0.6, 0.9, 0.9)
    poses = replace(poses, doubts={"0.png": "its pose is right with a probability of 60 %: it repeats"})
    found = with_later_evidence(poses, {"0.png": (0.01, "other views contradict it")})
    expected = "its pose is right with a probability of 1 %: other views contradict it; it repeats"
    assert found.doubts == {"0.png": expected}


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_a_certain_camera_can_be_contradicted(probability: float) -> None:
    found = with_later_evidence(poses_with(probability, 0.9, 0.9), {"0.png": (0.0, "other views contradict it")})
    assert found.right_probabilities is not None
    assert found.right_probabilities[0] == 0.0


def test_a_camera_of_which_nothing_was_measured_starts_from_the_usual_share_of_right_ones() -> None:
    usual = FITTED.probability({})
    assert set(probability_of(poses_with()).values()) == {usual}
    found = with_later_evidence(poses_with(), {"1.png": (0.5, "something")})
    assert found.right_probabilities is not None
    assert np.isnan(found.right_probabilities[[0, 2]]).all()
    assert found.right_probabilities[1] == pytest.approx(usual / (2 - usual))


def test_no_later_evidence_leaves_poses_as_they_are() -> None:
    poses = poses_with(0.5, 0.9, 0.9)
    assert with_later_evidence(poses, {"9.png": (0.1, "not of this group")}) is poses
