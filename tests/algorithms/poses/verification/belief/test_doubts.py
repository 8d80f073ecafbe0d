"""Doubts follow from the probability by two costs, and say what lowers it most."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.logistic import Model, Term
from pano_mvs.algorithms.poses.verification.belief.coefficients import FITTED
from pano_mvs.algorithms.poses.verification.belief.doubts import is_doubtful, is_left_out, reason

BEST = {
    "ratio": 1.2,
    "share": 0.8,
    "agreeing": 6.0,
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
    assert FITTED.probability(BEST) > 0.99


@pytest.mark.parametrize(
    ("worse", "said"),
    [
        ({"ratio": 0.1, "share": 0.05}, "confirm 5 % of its texture, but its neighbours suggest 50 %"),
        ({"agreeing": 0.0, "place_rival": np.nan}, "only 0 pairs agree with its place"),
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
        name: Term((0.0, 1.0), (loss,), 0.0) for name, loss in (("agreeing", 1.0), ("repeats", 2.0), ("share", 3.0))
    }
    found = reason(Model(1.0, terms), {"agreeing": 0.0, "repeats": 0.0, "share": 0.0})
    assert found.startswith("its pose is right with a probability of 1 %: other images confirm only 0 %")
    assert "the place repeats" in found
    assert "agree with its place" not in found
    assert found.endswith("take panoramas closer to one another there, or take panoramas in between")


def test_another_arrangement_is_named_without_a_claim_that_the_images_cannot_decide() -> None:
    found = reason(FITTED, BEST | {"repeats": 1.0}, ambiguity="the block may be elsewhere")
    assert "; the block may be elsewhere" in found
    assert "decided" not in found


def test_what_is_missing_is_said_as_such() -> None:
    found = reason(FITTED, dict.fromkeys(BEST, np.nan))
    assert "nan" not in found
