"""What speaks for the relative pose of a learned pair, and the fit of how much it counts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.algorithms.two_view.learned_pairs import ACCEPTED_ODDS, CERTAIN, WEIGHTS, marks_of, max_log10_of_learned
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from tests.algorithms.poses.synthetic_capture import features_from_bearings
from tools.benchmarks.poses.tours.pair_evidence import fitted, left_out, read_table

HEIGHT, DISTANCE = 1.6, 2.4
POSE = Rigid3.from_center(rotation_from_rotvec((0.0, 0.7, 0.0)), np.array([DISTANCE, 0.0, 0.0]))
TABLE = Path(__file__).parents[3] / "tools/benchmarks/poses/tours/pair_evidence.csv"


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


def test_a_true_pose_shows_the_floor_level_cameras_and_their_distance() -> None:
    rays = _rays(_room())
    first, second = (features_from_bearings(one) for one in rays)
    marks = marks_of(first, second, _unit(POSE), rays=rays)
    assert marks.alike == 0
    assert marks.tilt == pytest.approx(0, abs=1e-3)
    assert marks.climb == pytest.approx(0, abs=1e-3)
    assert marks.floor > 0.7
    assert marks.near == 0  # 1.6 m above the floor, 2.4 m apart
    close = Rigid3.from_center(POSE.rotation, np.array([0.2, 0.0, 0.0]))
    marks = marks_of(first, second, _unit(close), rays=_rays(_room(), close))
    assert marks.near == pytest.approx(np.log2(HEIGHT / 0.2), abs=0.01)
    assert marks.alike > 0


def test_a_tilted_or_climbing_pose_and_one_without_a_floor_have_less_to_say_for_them() -> None:
    rays = _rays(_room())
    first, second = (features_from_bearings(one) for one in rays)
    true = marks_of(first, second, _unit(POSE), rays=rays)
    tilted = Rigid3(rotation_from_rotvec((0.0, 0.0, 0.1)) @ POSE.rotation, POSE.translation)
    assert marks_of(first, second, _unit(tilted), rays=rays).tilt == pytest.approx(np.rad2deg(0.1), abs=1e-3)
    stair = Rigid3.from_center(POSE.rotation, np.array([1.5, -1.5, 0.0]))
    assert marks_of(first, second, _unit(stair), rays=_rays(_room(), stair)).climb == pytest.approx(45, abs=1e-3)
    walls = _rays(_room(below=0))
    without = marks_of(first, second, _unit(POSE), rays=walls)
    assert without.floor == 0
    assert max_log10_of_learned(true) > 5 * max_log10_of_learned(without)
    for worse in (true._replace(tilt=5.0), true._replace(climb=5.0), true._replace(alike=2.0), true._replace(near=2.0)):
        assert max_log10_of_learned(worse) < max_log10_of_learned(true)


def test_of_several_likely_zeniths_those_that_agree_count() -> None:
    rays = _rays(_room())
    first, second = (features_from_bearings(one) for one in rays)
    ups = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    turned = [replace(one, ups=ups, per_up=(0, 0, len(one)), learned=len(one)) for one in (first, second)]
    found = marks_of(turned[0], turned[1], _unit(POSE), rays=rays)
    assert found == marks_of(first, second, _unit(POSE), rays=rays)


def test_a_certain_pair_is_accepted_whatever_its_marks() -> None:
    rays = _rays(_room())
    first, second = (features_from_bearings(one) for one in rays)
    marks = marks_of(first, second, _unit(POSE), rays=rays)._replace(tilt=180.0, climb=90.0, floor=0.0, near=20.0)
    assert max_log10_of_learned(marks) == CERTAIN


def test_the_weights_are_those_of_the_table() -> None:
    rows = read_table(TABLE)
    assert fitted(rows) == pytest.approx(WEIGHTS, abs=0.02)
    assert pytest.approx(np.log(5)) == ACCEPTED_ODDS


def test_places_that_were_left_out_have_hardly_any_wrong_pair() -> None:
    """At 10⁻⁵⁰ alone, a quarter of the accepted pairs is wrong."""
    counts = np.array(list(left_out(read_table(TABLE)).values())).sum(axis=0)
    right, accepted, wrong, plain, plain_wrong = counts
    assert accepted > 0.7 * right
    assert wrong <= 0.05 * accepted
    assert plain_wrong > 0.2 * plain
