"""Every step on poses treats each group as if it were alone.

A camera that only a removed one connects to the rest has no place any more, whatever it looks like there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.adjustment.tracks import triangulate_tracks
from pano_mvs.algorithms.poses.frame.gauge import normalised_poses
from pano_mvs.algorithms.poses.frame.metric_scale import unit_translations
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel
from pano_mvs.algorithms.views import select_views
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.pose_groups import join_groups, split_groups
from tests.algorithms.poses.synthetic_capture import random_poses, synthetic_features, synthetic_two_views

Views = dict[tuple[str, str], TwoView]


@cache
def _room(seed: int, count: int, prefix: str) -> tuple[Poses, dict[str, Features], Views]:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, count)
    features = synthetic_features(rng, truth, points=200)
    pairs = synthetic_two_views(rng, features)
    known = {f"{prefix}{name}": Rigid3(pose.rotation, 2 * pose.translation + 0.01) for name, pose in truth.items()}
    return (
        Poses.without_points(known, frame=f"the room {prefix}", scale=f"unit of {prefix}", metric=False),
        {f"{prefix}{name}": found for name, found in features.items()},
        {(f"{prefix}{a}", f"{prefix}{b}"): view for (a, b), view in pairs.items()},
    )


_ORDER = ("b0.jpg", "a0.jpg", "b1.jpg", "a1.jpg", "b2.jpg")


def _small() -> tuple[Poses, dict[str, Features], Views]:
    return _room(1, 2, "a")


def _large() -> tuple[Poses, dict[str, Features], Views]:
    return _room(2, 3, "b")


def _features() -> dict[str, Features]:
    both = _small()[1] | _large()[1]
    return {name: both[name] for name in _ORDER}


def _pairs() -> Views:
    """Return all pairs and a false one between the rooms: a repeated door, say."""
    return _small()[2] | _large()[2] | {("b0.jpg", "a0.jpg"): next(iter(_large()[2].values()))}


def _triangulated(poses: Poses) -> Poses:
    return triangulate_tracks(poses, _features(), _pairs())


def _joined() -> Poses:
    return join_groups([_large()[0], _small()[0]], order=_ORDER, rejected={"x.jpg": "blurred"})


@pytest.mark.parametrize(
    "step",
    [_triangulated, normalised_poses, unit_translations, lambda poses: refine_poses(_triangulated(poses))],
    ids=["triangulate", "normalise", "unit_translations", "refine"],
)
def test_a_step_on_groups_is_the_step_on_each(step: Callable[[Poses], Poses]) -> None:
    together = step(_joined())
    together.check()
    assert together.names == _ORDER
    assert together.rejected == {"x.jpg": "blurred"}
    for number, (group, alone) in enumerate(zip(split_groups(together), (_large()[0], _small()[0]), strict=True)):
        expected = step(alone)
        for field in fields(Poses):
            found, wanted = getattr(group, field.name), getattr(expected, field.name)
            if isinstance(wanted, np.ndarray):
                np.testing.assert_array_equal(found, wanted, err_msg=f"{field.name} of group {number}")
            else:
                assert found == wanted, field.name


def test_sources_are_of_the_references_own_group() -> None:
    views = select_views(_joined(), sources=4)
    assert list(views.neighbours) == list(_ORDER)
    for reference, sources in views.neighbours.items():
        assert sorted(sources) == sorted(name for name in _ORDER if name[0] == reference[0] and name != reference)


def test_a_group_in_one_place_does_not_disturb_the_others() -> None:
    together = replace(_small()[0], translations=np.array(_small()[0].translations))
    together.translations[:] = 0.0
    views = select_views(join_groups([_large()[0], together], order=_ORDER))
    assert list(views.neighbours) == ["b0.jpg", "b1.jpg", "b2.jpg"]


@pytest.mark.parametrize(
    ("removed", "held"),
    [
        ([], []),
        ([3], [[4]]),
        ([2], [[3, 4]]),
        ([0], []),
        ([1, 3], [[4]]),
        ([2, 3], [[4]]),
        ([2, 1], [[0]]),
        ([5], []),
        ([7], []),
        ([2, 5], [[3, 4]]),
    ],
)
def test_images_that_hang_on_removed_ones_are_found(removed: list[int], held: list[list[int]]) -> None:
    """In a drawn house, the camera that one pair had placed stayed in the wrong room after its partner was removed."""
    model = PlacedModel(Pairs.without("abcdefgh"))
    # 5 and 6 are connected to nothing else, and 7 to nothing at all.
    model.chosen = dict.fromkeys([(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (5, 6)], 0)
    assert model.groups_held_by(removed) == held
