"""What speaks for the relative pose of a learned pair, and the fit of how much it counts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.algorithms.two_view.learned_pairs import (
    ACCEPTED_ODDS,
    ACCEPTED_ODDS_WITH_WALLS,
    CERTAIN,
    PRIOR_ODDS,
    WEIGHTS,
    WEIGHTS_WITH_WALLS,
    Marks,
    is_accepted,
    log_odds_of,
    marks_of,
    weight_of_learned,
)
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, geodesic_angle, rotation_from_rotvec
from tests.algorithms.poses.synthetic_capture import features_from_bearings
from tools.benchmarks.poses.tours.pair_evidence import fitted, left_out, prior_odds, read_table

HEIGHT, DISTANCE = 1.6, 2.4
POSE = Rigid3.from_center(rotation_from_rotvec((0.0, 0.7, 0.0)), np.array([DISTANCE, 0.0, 0.0]))
TABLES = Path(__file__).parents[3] / "tools/benchmarks/poses/tours"
TABLE, TABLE_WITH_WALLS = TABLES / "pair_evidence.csv", TABLES / "pair_evidence_walls.csv"


def _room(*, below: int = 60, above: int = 60) -> FloatArray:
    """Return points on a floor and on the walls around two cameras; y is down."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-2, 4, below), np.full(below, HEIGHT), rng.uniform(-3, 3, below)])
    walls = np.column_stack([rng.uniform(-2, 4, above), rng.uniform(-1.0, 0.0, above), rng.choice((-3.0, 3.0), above)])
    return np.concatenate([floor, walls])


def _rays(points: FloatArray, pose: Rigid3 = POSE) -> tuple[FloatArray, FloatArray]:
    first, second = points, pose.apply(points)
    return tuple(rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (first, second))


def _unit(pose: Rigid3) -> Rigid3:
    return Rigid3(pose.rotation, pose.translation / np.linalg.norm(pose.translation))


def _marks(rays: tuple[FloatArray, FloatArray], pose: Rigid3 = POSE, *, std_deg: float = 0.5) -> Marks:
    first, second = (features_from_bearings(one) for one in rays)
    return marks_of(first, second, _unit(pose), rays=rays, direction_std_deg=std_deg)


def test_a_true_pose_shows_the_floor_level_cameras_and_their_distance() -> None:
    marks = _marks(_rays(_room()))
    assert marks.tilt == pytest.approx(0, abs=1e-3)
    assert marks.floor > 0.7
    assert marks.near == 0  # 1.6 m above the floor, 2.4 m apart
    assert marks.parallax > np.log2(20)
    assert marks.open == -1
    close = Rigid3.from_center(POSE.rotation, np.array([1.0, 0.0, 0.0]))
    marks = _marks(_rays(_room(), close), close, std_deg=4.0)
    assert marks.near == pytest.approx(np.log2(HEIGHT), abs=0.01)
    assert marks.parallax < np.log2(20)
    assert marks.open == 2


def test_a_tilted_pose_and_one_without_a_floor_or_parallax_have_less_to_say_for_them() -> None:
    rays = _rays(_room())
    true = _marks(rays)
    tilted = Rigid3(rotation_from_rotvec((0.0, 0.0, 0.03)) @ POSE.rotation, POSE.translation)
    assert _marks(rays, tilted).tilt == pytest.approx(np.rad2deg(0.03), abs=1e-3)
    without = _marks(_rays(_room(below=0)))
    assert without.floor == 0
    assert log_odds_of(-50, without) < log_odds_of(-50, true) - 2
    worse = [true._replace(**{name: value}) for name, value in (("tilt", 4.0), ("near", 1.0), ("open", 1.0))]
    for marks in (*worse, true._replace(parallax=0.0)):
        assert log_odds_of(-50, marks) < log_odds_of(-50, true)


def test_of_several_likely_zeniths_those_that_agree_count() -> None:
    rays = _rays(_room())
    first, second = (features_from_bearings(one) for one in rays)
    ups = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    turned = [replace(one, ups=ups, per_up=(0, 0, len(one)), learned=len(one)) for one in (first, second)]
    assert marks_of(turned[0], turned[1], _unit(POSE), rays=rays, direction_std_deg=0.5) == _marks(rays)


def _with_walls(turn_deg: float = 0.0, tilt_deg: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return the frames of walls in the first camera, and in the second one at POSE."""
    first = rotation_from_rotvec(np.radians([0.0, 20.0, 0.0]))
    error = rotation_from_rotvec(np.radians([tilt_deg, turn_deg, 0.0]))
    quarter = rotation_from_rotvec((0.0, -np.pi / 2, 0.0))
    return first, error @ quarter @ first @ POSE.rotation.T


def test_walls_at_right_angles_and_a_level_baseline_speak_for_a_pose() -> None:
    rays = _rays(_room())
    plain = [features_from_bearings(one) for one in rays]

    def marks(turn_deg: float = 0.0, tilt_deg: float = 0.0, pose: Rigid3 = POSE) -> Marks:
        ends = [
            replace(features, walls_from_cam=walls)
            for features, walls in zip(plain, _with_walls(turn_deg, tilt_deg), strict=True)
        ]
        return marks_of(ends[0], ends[1], _unit(pose), rays=rays, direction_std_deg=0.5)

    assert (marks().walls, marks().level) == (-2.0, -1.0)
    assert marks(turn_deg=2.0).walls == pytest.approx(1.0)
    assert marks(tilt_deg=4.0).walls == pytest.approx(2.0)
    assert marks(turn_deg=44.0).walls == 4.0
    higher = Rigid3.from_center(POSE.rotation, np.array([DISTANCE, -DISTANCE / 5, 0.0]))
    assert marks(pose=higher).level == pytest.approx(np.log2(np.degrees(np.arctan(0.2))), abs=0.01)
    for worse in (marks(turn_deg=10.0), marks(pose=higher)._replace(floor=marks().floor)):
        assert log_odds_of(-60, worse) < log_odds_of(-60, marks())
    # An image that shows no walls leaves both unknown, and what is unknown counts neither for nor against a pose.
    half = replace(plain[0], walls_from_cam=_with_walls()[0])
    unknown = marks_of(half, plain[1], _unit(POSE), rays=rays, direction_std_deg=0.5)
    assert np.isnan([unknown.walls, unknown.level]).all()
    assert log_odds_of(-60, unknown) == log_odds_of(-60, _marks(rays))


def test_a_few_true_matches_are_found_by_the_walls_of_both_images() -> None:
    """Fifteen true matches among 120 that a network has found, where three at random are true once in 500 times."""
    rng = np.random.default_rng(4)
    points = _room(below=8, above=7)
    true = [one + rng.normal(0, 3e-4, one.shape) for one in _rays(points)]
    false = rng.normal(size=(2, 105, 3)) * [1.0, 0.4, 1.0]
    rays = [np.concatenate([one, other]) for one, other in zip(true, false, strict=True)]
    ends = [features_from_bearings(one / np.linalg.norm(one, axis=1, keepdims=True)) for one in rays]
    ends = [
        replace(one, learned=len(one), walls_from_cam=walls) for one, walls in zip(ends, _with_walls(), strict=True)
    ]
    idx = np.stack([np.arange(120)] * 2, axis=1).astype(np.int32)
    view = verify_pair(ends[0], ends[1], idx, rng=np.random.default_rng(0))
    hypotheses = [view] if view else view.alternatives
    off = [np.degrees(geodesic_angle(one.rotation, POSE.rotation)) for one in hypotheses]
    assert min(off) < 1.0
    assert view.log10_false_alarms < 0


def test_walls_refuse_a_probable_pose_only_if_they_contradict_it() -> None:
    probable = Marks(tilt=0.2, floor=0.8, near=0.0, parallax=4.5, open=-2.0)
    assert is_accepted(-100.0, probable)
    for walls, accepted in ((-2.0, True), (1.5, True), (2.5, False)):
        marks = probable._replace(walls=walls, level=0.0)
        assert is_accepted(-100.0, marks) == accepted
        assert is_accepted(-100.0, marks, further=-6.0) is False
    # One that is not, is accepted if walls speak for it.
    improbable = probable._replace(floor=0.0, parallax=3.0)
    assert not is_accepted(-60.0, improbable)
    assert is_accepted(-60.0, improbable._replace(walls=-2.0, level=-1.0), further=1.0)
    assert not is_accepted(-60.0, improbable._replace(walls=1.5, level=-1.0), further=1.0)


def test_what_a_pair_weighs_beside_others() -> None:
    marks = _marks(_rays(_room()))
    accepted = next(exponent for exponent in range(3, 400) if log_odds_of(-exponent, marks) >= ACCEPTED_ODDS)
    assert weight_of_learned(-accepted, marks) == pytest.approx(1, abs=0.02)
    assert weight_of_learned(-accepted - 100.0, marks) > 1
    bad = marks._replace(tilt=4.0, floor=0.0, near=1.0)
    assert weight_of_learned(-20.0, bad) == 0  # less probable than any pair
    assert weight_of_learned(CERTAIN, bad) == 1


def test_the_weights_are_those_of_the_table() -> None:
    rows = read_table(TABLE)
    assert fitted(rows) == pytest.approx(WEIGHTS, abs=0.02)
    assert fitted(read_table(TABLE_WITH_WALLS)) == pytest.approx(WEIGHTS_WITH_WALLS, abs=0.02)
    assert prior_odds(rows) == pytest.approx(PRIOR_ODDS, abs=0.02)
    assert pytest.approx(np.log(5)) == ACCEPTED_ODDS
    assert pytest.approx(np.log(12)) == ACCEPTED_ODDS_WITH_WALLS


def test_places_that_were_left_out_have_hardly_any_wrong_pair() -> None:
    """At 10⁻⁵⁰ alone, a quarter of the accepted pairs is wrong."""
    counts = np.array(list(left_out(read_table(TABLE)).values())).sum(axis=0)
    right, accepted, wrong, plain, plain_wrong = counts
    assert accepted > 0.7 * right
    assert wrong <= 0.05 * accepted
    assert plain_wrong > 0.2 * plain
    right, accepted, wrong, *_ = np.array(list(left_out(read_table(TABLE_WITH_WALLS)).values())).sum(axis=0)
    assert accepted >= 0.9 * right
    assert wrong <= 0.01 * accepted


def test_of_two_poses_that_matches_agree_on_the_more_probable_one_counts() -> None:
    """A hundred matches of a room with its floor, and 160 that look alike as if seen from one place."""
    rng = np.random.default_rng(3)
    alike = Rigid3(rotation_from_rotvec((0.03, 2.0, 0.02)), np.array([0.9, 0.1, 0.0]))
    far = rng.normal(size=(160, 3))
    far *= rng.uniform(20, 40, (160, 1)) / np.linalg.norm(far, axis=1, keepdims=True)
    rays = [
        np.concatenate(both) + rng.normal(0, 3e-4, (260, 3))
        for both in zip(_rays(_room(below=60, above=40)), _rays(far, alike), strict=True)
    ]
    first, second = (features_from_bearings(one / np.linalg.norm(one, axis=1, keepdims=True)) for one in rays)
    idx = np.stack([np.arange(260)] * 2, axis=1).astype(np.int32)
    plain = verify_pair(first, second, idx, rng=np.random.default_rng(0))
    one, other = (replace(features, learned=len(features)) for features in (first, second))
    view = verify_pair(one, other, idx, rng=np.random.default_rng(0))
    assert geodesic_angle(plain.rotation, alike.rotation) < 0.01
    assert view
    assert geodesic_angle(view.rotation, POSE.rotation) < 0.01
