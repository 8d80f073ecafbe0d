"""Geometries of ambiguous pairs weighed by the images, with pictures of the synthetic room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NoReturn

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.placed_model import Pairs, pairs_of
from pano_mvs.algorithms.poses.verification import pair_weights
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation
from pano_mvs.algorithms.poses.verification.pair_weights import is_ambiguous, weighed_by_images
from pano_mvs.geometry import Rigid3
from tests.algorithms.poses.aliased_capture import same_matches, view_of
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings, points_in_box
from tests.algorithms.room_pictures import WHOLE, moved, room_capture

POSES, PICTURES = room_capture()
NAMES = [f"{idx}.jpg" for idx in range(len(POSES))]
AMBIGUOUS, CLEAR, FEIGNED_BY_FEW = (0, 1), (0, 2), (1, 2)


def pairs(*, true: int = 60, false: int = 150) -> Pairs:
    """Return the pairs of a capture; some have a geometry that puts the second image half a unit elsewhere."""
    rng = np.random.default_rng(17)
    points = points_in_box(rng, 200)
    features = {
        name: features_from_bearings(noisy_bearings(rng, pose, points, noise_deg=0.05))
        for name, pose in zip(NAMES, POSES, strict=True)
    }
    views = {}
    for i, j in combinations(range(len(POSES)), 2):
        truth = view_of(POSES[j] @ POSES[i].inverse(), same_matches(true))
        feigned = moved(POSES[j], (0.5, 0.0, -0.4)) @ POSES[i].inverse()
        if (i, j) == AMBIGUOUS:
            truth = view_of(feigned, same_matches(false)).with_alternatives([truth])
        elif (i, j) == FEIGNED_BY_FEW:
            truth = truth.with_alternatives([view_of(feigned, same_matches(2))])
        views[NAMES[i], NAMES[j]] = truth
    return pairs_of(features, views)


def confirmation_of(pictures: Sequence[NDArray[np.uint8]] = PICTURES) -> Confirmation:
    return Confirmation(lambda image: (pictures[image], WHOLE))


def is_true(pairs: Pairs, edge: tuple[int, int], rank: int) -> bool:
    first, second = edge
    direction = (POSES[second] @ POSES[first].inverse()).translation
    return bool(pairs.geometries[edge][rank].view.direction @ direction / np.linalg.norm(direction) > 0.999)


def test_the_true_geometry_of_an_ambiguous_pair_becomes_the_heaviest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pair_weights, "_MIN_AMBIGUOUS", 0.05)  # one of ten pairs is ambiguous here
    before = pairs()
    after = weighed_by_images(before, confirmation_of())
    assert not is_true(before, AMBIGUOUS, 0)
    assert is_true(after, AMBIGUOUS, 0)
    first, second = after.geometries[AMBIGUOUS]
    assert second.weight < 0.3 * first.weight
    assert first.weight == pytest.approx(before.geometries[AMBIGUOUS][0].weight)


def test_clear_pairs_keep_their_weights() -> None:
    before = pairs()
    after = weighed_by_images(before, confirmation_of())
    assert is_ambiguous(before.geometries[AMBIGUOUS])
    for edge in (CLEAR, FEIGNED_BY_FEW):
        assert not is_ambiguous(before.geometries[edge])
        assert after.geometries[edge] == before.geometries[edge]
    assert after.names == before.names


def test_a_capture_with_few_ambiguous_pairs_is_not_asked_for() -> None:
    """The other pairs outvote them, and a sweep of every pair costs more than all of its matching."""

    def load(image: int) -> NoReturn:
        raise AssertionError("nobody should look at the images")

    before = pairs()
    assert weighed_by_images(before, Confirmation(load)) is before


def test_a_capture_without_texture_leaves_all_weights_as_they_are() -> None:
    before = pairs()
    plain = [np.full_like(picture, 90) for picture in PICTURES]
    assert weighed_by_images(before, confirmation_of(plain)).geometries == before.geometries


def test_a_pair_that_both_pictures_deny_alike_is_decided_by_nobody() -> None:
    """Two copies of one geometry have the same share, so the order of matches stays."""
    before = pairs()
    edge = AMBIGUOUS
    view = before.geometries[edge][0].view
    twice = view.with_alternatives([view_of(Rigid3(view.rotation, view.direction), same_matches(100))])
    again = pairs_of(before.features, {(NAMES[edge[0]], NAMES[edge[1]]): twice})
    after = weighed_by_images(again, confirmation_of())
    assert [len(one.view) for one in after.geometries[edge]] == [150, 100]


class Asked(Confirmation):
    """Confirms everything alike, and remembers which images were compared."""

    def __init__(self) -> None:
        super().__init__(lambda image: (PICTURES[0], WHOLE))
        self.edges: set[tuple[int, ...]] = set()

    def share(self, image: int, pose: Rigid3, cameras: Mapping[int, Rigid3]) -> float:
        self.edges.add(tuple(sorted(cameras)))
        return 0.5


def test_of_many_pairs_only_those_of_the_best_partners_are_asked_and_the_others_count_less() -> None:
    """The images at the ends of a long row share least."""
    count = 16
    few = pairs()
    true, feigned = few.geometries[AMBIGUOUS]
    geometries = {
        (i, j): tuple(
            replace(one, view=replace(one.view, matches_idx=one.view.matches_idx[: 50 - (j - i)]))
            for one in (true, feigned)
        )
        for i, j in combinations(range(count), 2)
    }
    features = {f"{idx}.jpg": next(iter(few.features.values())) for idx in range(count)}
    asked = Asked()
    after = weighed_by_images(Pairs(features, geometries), asked)
    assert all((idx, idx + 1) in asked.edges for idx in range(count - 1))
    assert (0, count - 1) not in asked.edges
    assert set(after.geometries) == set(geometries)
    for edge, found in after.geometries.items():
        changed = found[0].weight / geometries[edge][0].weight
        assert changed == pytest.approx(1.0) if edge in asked.edges else changed < 0.9
