"""Rooms that share too few matches for a pair are joined by all matches together, and only if these decide."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.pair_evidence import significant_length
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, Poses
from tests.algorithms.poses.joining.two_rooms import matched, room_features, room_poses


def _solved(features: dict[str, Features]) -> Poses:
    return solve_scaled_translation(features, matched(features), rng=np.random.default_rng(0))


def _errors(poses: Poses, truth: dict[str, Rigid3]) -> tuple[float, float]:
    """Return the largest error of a relative rotation in degrees, and of a centre relative to the first two."""
    first = poses.names[0]
    placed = {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
    turns = [
        (placed[name].rotation @ placed[first].rotation.T) @ (truth[name].rotation @ truth[first].rotation.T).T
        for name in poses.names
    ]
    angles = [float(np.rad2deg(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))) for turn in turns]
    centers, true = (np.array([one[name].center for name in poses.names]) for one in (placed, truth))
    own = (centers - centers[0]) @ placed[first].rotation.T
    other = (true - true[0]) @ truth[first].rotation.T
    scale = np.linalg.norm(other[1]) / np.linalg.norm(own[1])
    return max(angles), float(np.linalg.norm(scale * own - other, axis=1).max())


@pytest.mark.parametrize("turned", [False, True])
def test_rooms_are_joined_by_the_matches_of_all_their_pairs(turned: bool) -> None:
    truth = room_poses(turned=turned)
    features = room_features(truth, door=8, false=60)
    views = matched(features)
    assert sum(bool(view) for pair, view in views.items() if pair[0][0] != pair[1][0]) < 2
    poses = _solved(features)
    assert len(poses.names) == 4
    assert len(poses.worlds) == 1
    turn_deg, off = _errors(poses, truth)
    assert turn_deg < 0.5
    assert off < 0.1


def test_unrelated_places_stay_two_groups() -> None:
    features = room_features(room_poses(), door=0)
    poses = _solved(features)
    assert len(poses.names) == 4
    assert len(poses.worlds) == 2


def test_rooms_that_fit_in_two_places_stay_two_groups() -> None:
    """Every point behind the door is seen twice: where it is, and where an equal room would have it."""
    truth = room_poses(turned=True)
    shifted = {
        name: Rigid3.from_center(pose.rotation, pose.center + np.array([0.0, 0.0, 1.1 * (name[0] == "b")]))
        for name, pose in truth.items()
    }
    own, door = 220, 8
    here = room_features(truth, door=door, own=own, false=60)
    there = room_features(shifted, door=door, own=own, door_seed=8)
    both = {name: _stacked(here[name], there[name], slice(own, own + 2 * door)) for name in truth}
    assert len(_solved(here).worlds) == 1
    assert len(_solved(both).worlds) == 2


def _stacked(first: Features, second: Features, door: slice) -> Features:
    """Return the key points of the first image, and those behind the door of the second one."""
    names = "bearings", "descriptors", "sizes_rad", "scores", "colors_rgb"
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(first, name), getattr(second, name)[door]]) for name in names
    }
    return replace(first, **arrays)


def test_a_length_is_more_than_chance_if_ranges_agree() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(30, 3)) * (4, 1, 4)
    pose = Rigid3(np.eye(3), np.array([0.6, 0.0, 0.8]))
    moved = points + 2.5 * pose.translation
    p, q = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (points, moved))
    ranges = np.linalg.norm(points, axis=1)
    length, alarms = significant_length(pose, p, q, known_ranges=ranges, rng=rng)
    assert length == pytest.approx(2.5, rel=1e-6)
    assert alarms < -5
    assert significant_length(pose, p, q, known_ranges=rng.permutation(ranges), rng=rng)[1] > -1
    assert significant_length(pose, p, q, known_ranges=np.full(30, np.nan), rng=rng)[1] == np.inf
