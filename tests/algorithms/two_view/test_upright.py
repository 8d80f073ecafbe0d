"""Relative poses of upright images, and poses that are known from other pairs: few true matches suffice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.two_view.redirection import upright_poses
from pano_mvs.algorithms.two_view.verification import verify_pair, verify_pose
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle, rotation_from_rotvec
from pano_mvs.scene import Features
from tests.algorithms.poses.synthetic_capture import features_from_bearings


def _pair(*, true: int, count: int, tilt_deg: float, seed: int = 6) -> tuple[Rigid3, Features, Features]:
    """Return a relative pose |t| = 1 of two cameras at one height, and key points of which only the first are true."""
    rng = np.random.default_rng(seed)
    tilt = rotation_from_rotvec(np.deg2rad([tilt_deg, 0, -0.7 * tilt_deg]))
    direction = np.array([0.9, 0.05, -0.4])
    pose = Rigid3(tilt @ rotation_from_rotvec((0.0, 2.1, 0.0)), direction / np.linalg.norm(direction))
    points = 3 * rng.normal(size=(count, 3))
    p, q = _unit(points), _unit(pose.apply(points))
    q[true:] = q[true:][rng.permutation(count - true)]
    return pose, features_from_bearings(p), features_from_bearings(q)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _all(count: int) -> np.ndarray:
    return np.stack([np.arange(count)] * 2, axis=1).astype(np.int32)


def test_upright_images_need_few_true_matches() -> None:
    pose, first, second = _pair(true=20, count=160, tilt_deg=0.7)
    p, q = first.bearings, second.bearings
    rng = np.random.default_rng(1)
    best = upright_poses(p, q, rng=rng, threshold_rad=0.005)[0]
    assert float(geodesic_angle(best.rotation, pose.rotation)) < np.deg2rad(0.5)
    assert float(angle_between(best.translation, pose.translation)) < np.deg2rad(2)
    assert upright_poses(p[:3], q[:3], rng=rng, threshold_rad=0.005) == []


def test_a_pair_is_verified_as_upright_where_five_matches_find_nothing() -> None:
    """24 of 200 matches are true: five at random are all true in one sample of 4·10⁴."""
    pose, first, second = _pair(true=24, count=200, tilt_deg=0.0)
    view = verify_pair(first, second, _all(200), rng=np.random.default_rng(0))
    assert view
    assert view.log10_false_alarms < -6
    assert float(geodesic_angle(view.rotation, pose.rotation)) < np.deg2rad(0.5)
    assert len(view.all_matches_idx) == 200


@pytest.mark.parametrize("seed", range(4))
def test_random_matches_are_chance_upright_or_not_and_keep_their_hypotheses(seed: int) -> None:
    _, first, second = _pair(true=0, count=150, tilt_deg=0.0, seed=seed)
    view = verify_pair(first, second, _all(150), rng=np.random.default_rng(seed))
    assert not view
    assert len(view) == 0
    assert len(view.all_matches_idx) == 150
    assert view.alternatives
    assert view.log10_false_alarms > -6


def test_a_known_pose_needs_fewer_matches_than_a_search() -> None:
    pose, first, second = _pair(true=14, count=120, tilt_deg=20.0)
    assert not verify_pair(first, second, _all(120), rng=np.random.default_rng(0))
    near = Rigid3(rotation_from_rotvec((0.0, 0.002, 0.0)) @ pose.rotation, 3 * pose.translation)
    known = verify_pose(first, second, _all(120), pose=near, rng=np.random.default_rng(0))
    assert known
    assert set(range(14)) <= {*known.matches_idx[:, 0].tolist()}
    other = Rigid3(rotation_from_rotvec((0.0, 0.5, 0.0)) @ pose.rotation, pose.translation)
    assert not verify_pose(first, second, _all(120), pose=other, rng=np.random.default_rng(0))
    still = Rigid3(pose.rotation, np.zeros(3))
    nowhere = verify_pose(first, second, _all(120), pose=still, rng=np.random.default_rng(0))
    assert "8 needed" in nowhere.reason


def test_learned_matches_must_be_far_more_than_chance() -> None:
    """A network's false matches, such as those of equal doors, agree with one another, also on upright poses."""
    for true, tilt_deg in ((40, 8.0), (40, 0.0)):
        _, first, second = _pair(true=true, count=90, tilt_deg=tilt_deg)
        plain = verify_pair(first, second, _all(90), rng=np.random.default_rng(0))
        assert plain
        assert -50 < plain.log10_false_alarms < -6
        level, other = (replace(one, learned=len(one)) for one in (first, second))
        found = verify_pair(level, other, _all(90), rng=np.random.default_rng(0))
        assert "two things that look alike" in found.reason
        assert found.alternatives
    _, first, second = _pair(true=400, count=400, tilt_deg=0.0)
    level, other = (replace(one, learned=len(one)) for one in (first, second))
    assert verify_pair(level, other, _all(400), rng=np.random.default_rng(0))


@pytest.mark.parametrize(("depth_m", "verified"), [((1.0, 4.0), True), ((40.0, 80.0), False)])
def test_learned_matches_that_a_rotation_explains_must_be_more_significant(
    depth_m: tuple[float, float], verified: bool
) -> None:
    """A network matches what looks alike in two places as if both were seen from one place."""
    rng = np.random.default_rng(4)
    pose = Rigid3(rotation_from_rotvec((0.0, 0.9, 0.0)), np.array([0.6, 0.0, 0.8]))
    points = _unit(rng.normal(size=(100, 3))) * rng.uniform(*depth_m, (100, 1))
    seen = pose.apply(points)
    seen[80:] = rng.normal(size=(20, 3))
    first, second = (features_from_bearings(_unit(rays)) for rays in (points, seen))
    plain = verify_pair(first, second, _all(100), rng=np.random.default_rng(0))
    assert plain.log10_false_alarms < -60
    first, second = (replace(one, learned=len(one)) for one in (first, second))
    found = verify_pair(first, second, _all(100), rng=np.random.default_rng(0))
    assert bool(found) is verified
    assert verified or "two things that look alike" in found.reason
    assert verified or found.alternatives


def test_a_refused_learned_pair_keeps_its_most_probable_pose_where_five_matches_find_nothing() -> None:
    pose, first, second = _pair(true=30, count=290, tilt_deg=0.0)
    level, other = (replace(one, learned=len(one)) for one in (first, second))
    for most in (0, 2):
        view = verify_pair(level, other, _all(290), rng=np.random.default_rng(0), max_alternatives=most)
        assert not view
        assert -20 < view.log10_false_alarms < -10
        assert 1 <= len(view.alternatives) <= 1 + most
        assert float(geodesic_angle(view.alternatives[0].rotation, pose.rotation)) < np.deg2rad(0.5)
