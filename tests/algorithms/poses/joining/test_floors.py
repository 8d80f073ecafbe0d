"""Rooms that one pair joins, whose lengths are open: the heights above the floors determine them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.poses.joining import join_groups
from pano_mvs.algorithms.poses.joining.floors import scale_of_floors
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, Poses
from tests.algorithms.poses.joining.two_rooms import matched, room_features, room_poses, with_points_of_pairs


def capture(truth: dict[str, Rigid3]) -> dict[str, Features]:
    """One pair of two rooms has many matches; the other camera of the first room sees a few of its points."""
    features = room_features(truth, door=0, own=600)
    return with_points_of_pairs(
        with_points_of_pairs(features, truth, [("a1", "b1")], count=80), truth, [("a1", "a2", "b1")], count=12
    )


def solved(features: dict[str, Features]) -> Poses:
    return solve_scaled_translation(features, matched(features), rng=np.random.default_rng(0))


def models(features: dict[str, Features], truth: dict[str, Rigid3], *, unit: float) -> list[PlacedModel]:
    """Both rooms with true poses and ranges, the second one in another unit."""
    found = []
    for number, room in enumerate("ab"):
        model = PlacedModel(pairs_of(features, {}))
        scale = unit if number else 1.0
        for image, name in enumerate(features):
            if name[0] == room:
                model.cameras[image] = Rigid3.from_center(truth[name].rotation, truth[name].center * scale)
                # Of points on the walls of a box, which room_features draws around (±2, 0, 0).
                rays = features[name].bearings @ truth[name].rotation
                middle = np.array([-2.0 if room == "a" else 2.0, 0.0, 0.0])
                reach = (np.sign(rays) * (1.9, 1.3, 2.0) + middle - truth[name].center) / rays
                model.set_ranges(image, scale * reach.min(axis=1))
        found.append(model)
    return found


def test_a_pair_and_the_floors_join_two_rooms(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = room_poses()
    features = capture(truth)
    poses = solved(features)
    assert len(poses.names) == 4
    assert len(poses.worlds) == 1
    lengths = {
        pair: [float(np.linalg.norm(one[pair[0]].center - one[pair[1]].center)) for one in (truth, placed(poses))]
        for pair in (("a1", "a2"), ("b1", "b2"), ("a1", "b1"))
    }
    scale = lengths["a1", "a2"][1] / lengths["a1", "a2"][0]
    for true, found in lengths.values():
        assert found == pytest.approx(scale * true, rel=0.08)
    monkeypatch.setattr(join_groups, "scale_of_floors", lambda first, second: None)
    assert len(solved(features).worlds) == 2


def placed(poses: Poses) -> dict[str, Rigid3]:
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}


def test_the_floors_give_the_ratio_of_the_units() -> None:
    truth = room_poses()
    first, second = models(room_features(truth, door=0, own=600), truth, unit=3.0)
    scale = scale_of_floors(first, second)
    assert scale is not None
    assert scale == pytest.approx(1 / 3, rel=0.05)


def test_cameras_that_are_turned_or_at_different_heights_give_none() -> None:
    turned = room_poses(turned=True)
    assert scale_of_floors(*models(room_features(turned, door=0, own=600), turned, unit=1.0)) is None
    truth = room_poses()
    raised = {
        name: replace(pose, translation=pose.translation - pose.rotation @ np.array([0.0, 0.4 * (name == "a2"), 0.0]))
        for name, pose in truth.items()
    }
    assert scale_of_floors(*models(room_features(raised, door=0, own=600), raised, unit=1.0)) is None
    few = room_features(truth, door=0, own=60)
    assert scale_of_floors(*models(few, truth, unit=1.0)) is None
