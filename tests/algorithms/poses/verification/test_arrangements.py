"""Arrangements are compared as wholes: what all cameras together confirm decides, not what the matches say."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.verification.arrangements import (
    SHARE_STD,
    is_better_arrangement,
    is_more_confirmed,
)
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, Evidence
from pano_mvs.algorithms.poses.verification.correct_cameras import correct_cameras
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from tests.algorithms.room_pictures import WHOLE, Vector, moved, room_capture, room_matches

POSES, PICTURES = room_capture()
AWAY: Vector = (0.5, 0.0, -0.4)


def confirmation() -> Confirmation:
    return Confirmation(lambda image: (PICTURES[image], WHOLE))


def test_a_gain_counts_against_what_others_lose() -> None:
    before = dict.fromkeys(range(5), 0.6)
    assert is_more_confirmed({**before, 0: 0.8}, before)
    assert not is_more_confirmed({**before, 0: 0.8, 1: 0.5, 2: 0.5}, before)
    assert not is_more_confirmed(before, {**before, 0: 0.8})


def test_a_gain_within_the_noise_of_the_cameras_that_changed_counts_as_none() -> None:
    before = dict.fromkeys(range(100), 0.6)
    one, all_of_them = ({**before, **dict.fromkeys(range(count), 0.6 + 1.5 * SHARE_STD)} for count in (1, 100))
    assert not is_more_confirmed(one, before)
    assert is_more_confirmed(all_of_them, before)
    assert is_more_confirmed({**before, 0: 0.6 + 2.5 * SHARE_STD}, before)


def test_a_camera_that_is_missing_or_cannot_be_judged_confirms_nothing() -> None:
    both = {0: 0.6, 1: 0.6}
    assert is_more_confirmed(both, {0: 0.6})
    assert is_more_confirmed(both, {0: 0.6, 1: np.nan})
    assert not is_more_confirmed({0: np.nan}, {})


@pytest.mark.slow
def test_a_camera_in_a_wrong_place_makes_an_arrangement_no_better() -> None:
    """Another source makes the maps of the others better, wherever it is: three right cameras lost against four."""
    pictures = room_capture((128, 256))[1]  # in smaller ones this place is confirmed by chance
    asked = Confirmation(lambda image: (pictures[image], np.ones((128, 256), np.bool_)))
    rng = np.random.default_rng(1)
    three = {image: POSES[image] for image in range(3)}
    turn = rotation_from_rotvec([0.0, rng.uniform(1.0, 5.0), 0.0])
    wrong = Rigid3.from_center(turn @ POSES[3].rotation, POSES[3].center + rng.normal(size=3))
    assert not is_better_arrangement({**three, 3: wrong}, three, asked)
    assert is_better_arrangement({**three, 3: POSES[3]}, three, asked)
    assert is_better_arrangement({**three, 3: POSES[3]}, {**three, 3: wrong}, asked)


@pytest.mark.slow
def test_true_poses_stay_where_most_matches_have_a_camera_elsewhere() -> None:
    """Regression: in a hall with a tiled floor, false matches moved two of nine right cameras."""
    features, two_views = room_matches({2: AWAY}, false=120)
    model = PlacedModel(pairs_of(features, two_views)).with_cameras(dict(enumerate(POSES)))
    corrected, checks = correct_cameras(model, confirmation())
    assert not checks.moved
    assert not checks.removed
    assert corrected.cameras == model.cameras


@pytest.mark.slow
def test_the_images_refute_the_place_that_most_matches_suggest() -> None:
    """A refuted place is no rival: right cameras of repeating places were doubted because of such."""
    features, two_views = room_matches({2: AWAY}, false=120)
    model = PlacedModel(pairs_of(features, two_views)).with_cameras(dict(enumerate(POSES)))
    miss_cost = 1000.0  # doubts all cameras, so that their other places are compared
    _, checks = correct_cameras(model, confirmation(), miss_cost=miss_cost)
    _, reported = correct_cameras(model, confirmation(), fixed=range(len(POSES)), miss_cost=miss_cost)
    assert reported.evidence[2]["place_rival"] > 0
    assert checks.evidence[2]["place_rival"] == 0
    assert checks.p_right[2] > reported.p_right[2]
    feigned = moved(POSES[2], AWAY)
    assert min(np.linalg.norm(pose.center - feigned.center) for pose in checks.refuted[2]) < 0.1


def test_what_is_seen_without_parallax_does_not_count_for_an_arrangement() -> None:
    near, far = np.zeros(10), np.zeros(10)
    near[3], far[-1] = 2.0, 6.0
    assert Evidence(near + far, near).parallax_share == pytest.approx(1.0)
    assert Evidence(near + far, near).share == pytest.approx(0.25)
    assert np.isnan(Evidence(far, far).parallax_share)
