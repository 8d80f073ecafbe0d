"""Photographs are matched with the panoramas that show the same place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.photograph_candidates import similar_panoramas

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
