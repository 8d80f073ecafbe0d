"""Photographs are matched with the panoramas that show the same place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.brute_force import match_l2
from pano_mvs.algorithms.poses.photograph_candidates import similar_panoramas as similar_to_each

Descriptors = NDArray[np.float32]


@pytest.fixture
def panoramas() -> dict[str, Descriptors]:
    """Eight panoramas in pairs: two share the key points of a place, up to noise."""
    rng = np.random.default_rng(4)
    places = [rng.integers(0, 200, (60, 128)) for _ in range(4)]
    return {
        f"{place}{copy}": np.asarray(points + rng.integers(-3, 4, points.shape) + 3, np.float32)
        for copy in "ab"
        for place, points in enumerate(places)
    }


def photograph_of(panoramas: Mapping[str, Descriptors], name: str, count: int = 25) -> Descriptors:
    return panoramas[name][5 : 5 + count] + 1


def similar_panoramas(photograph: Descriptors, panoramas: Mapping[str, Descriptors], *, count: int) -> list[str]:
    (found,) = similar_to_each([photograph], panoramas.items(), count=count)
    return found


@pytest.mark.parametrize("place", range(4))
def test_the_panoramas_of_the_place_are_chosen(panoramas: dict[str, Descriptors], place: int) -> None:
    assert similar_panoramas(photograph_of(panoramas, f"{place}b"), panoramas, count=2) == [f"{place}a", f"{place}b"]


def test_the_order_of_the_capture_is_kept(panoramas: dict[str, Descriptors]) -> None:
    backwards = dict(reversed(panoramas.items()))
    assert similar_panoramas(photograph_of(panoramas, "1a"), backwards, count=2) == ["1b", "1a"]


@pytest.mark.parametrize("count", [0, 8, 20])
def test_small_captures_are_used_completely(panoramas: dict[str, Descriptors], count: int) -> None:
    assert similar_panoramas(photograph_of(panoramas, "1a"), panoramas, count=count) == list(panoramas)


def test_the_strongest_key_points_decide(panoramas: dict[str, Descriptors]) -> None:
    """Key points beyond the sample are not compared."""
    noise = np.asarray(np.random.default_rng(7).integers(0, 200, (300, 128)), np.float32)
    hidden = np.concatenate([photograph_of(panoramas, "2a", 4), noise[4:], photograph_of(panoramas, "1a", 50)])
    assert similar_panoramas(hidden, panoramas, count=2) == ["2a", "2b"]


def test_without_key_points_the_first_are_taken(panoramas: dict[str, Descriptors]) -> None:
    assert similar_panoramas(np.zeros((0, 128), np.float32), panoramas, count=2) == list(panoramas)[:2]
    bare = {name: np.zeros((0, 128), np.float32) for name in panoramas} | {"3b": panoramas["3b"]}
    assert similar_panoramas(photograph_of(panoramas, "3b"), bare, count=1) == ["3b"]


def test_photographs_are_compared_together_in_one_pass(panoramas: dict[str, Descriptors]) -> None:
    photographs = [photograph_of(panoramas, f"{place}a") for place in (2, 0, 3)]
    found = similar_to_each(photographs, iter(panoramas.items()), count=2)
    assert found == [similar_panoramas(photograph, panoramas, count=2) for photograph in photographs]
    assert found == [["2a", "2b"], ["0a", "0b"], ["3a", "3b"]]


def test_descriptors_with_fractions_are_compared_too(panoramas: dict[str, Descriptors]) -> None:
    fractions = {name: known / np.float32(512) for name, known in panoramas.items()}
    assert similar_panoramas(photograph_of(panoramas, "1a") / np.float32(512), fractions, count=2) == ["1a", "1b"]


def test_the_count_is_that_of_brute_force_matching(panoramas: dict[str, Descriptors]) -> None:
    """Matches are counted one to one, also where several key points have the same nearest neighbour."""
    rng = np.random.default_rng(11)
    copies = np.concatenate([photograph_of(panoramas, "2a", 30)] * 3)
    photograph = copies + np.asarray(rng.integers(0, 3, copies.shape), np.float32)
    expected = {name: len(match_l2(photograph, known, ratio=0.8)) for name, known in panoramas.items()}
    for count in range(1, 8):
        best = sorted(panoramas, key=lambda name: -expected[name])[:count]
        assert similar_panoramas(photograph, panoramas, count=count) == [name for name in panoramas if name in best]
