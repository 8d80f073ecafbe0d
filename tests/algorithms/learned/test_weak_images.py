"""Learned matches are for images that SIFT leaves weakly connected, and for those only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pano_mvs.algorithms.learned.aliked import joined
from pano_mvs.algorithms.learned.networks import DESCRIPTOR_NORM
from pano_mvs.algorithms.learned.weak_images import learned_pairs, weak_images
from pano_mvs.core.errors import UsageError
from pano_mvs.scene import Features, TwoView

NAMES = tuple("abcdef")


def features_of(name: str, *, place: int = 0, learned: bool = False) -> Features:
    """Key points whose descriptors depend on the place, with noise of each image."""
    of_place, own = np.random.default_rng(place), np.random.default_rng(ord(name))
    descriptors = of_place.normal(size=(300, 128)) + 0.1 * own.normal(size=(300, 128))
    descriptors *= DESCRIPTOR_NORM / np.linalg.norm(descriptors, axis=1, keepdims=True)
    bearings = own.normal(size=(300, 3))
    return Features(
        bearings=bearings / np.linalg.norm(bearings, axis=1, keepdims=True),
        descriptors=np.rint(descriptors).astype(np.float32),
        sizes_rad=np.full(300, 0.01, np.float32),
        scores=np.linspace(1, 0.1, 300, dtype=np.float32),
        colors_rgb=np.zeros((300, 3), np.uint8),
        metric="l2",
        size_hw=(64, 128),
        learned=300 if learned else 0,
    )


def pair_of(count: int) -> TwoView:
    idx = np.stack([np.arange(count)] * 2, axis=1).astype(np.int32)
    return TwoView(idx, np.eye(3), np.array([1.0, 0, 0]), np.zeros(count, np.float32), "general")


CAPTURE: Mapping[str, Features] = {name: features_of(name, place=name in "ef") for name in NAMES}
CHAIN = {pair: pair_of(150) for pair in pairwise(NAMES)}


def test_images_that_strong_pairs_connect_need_nothing() -> None:
    found = weak_images(CAPTURE, CHAIN | {("a", "f"): TwoView.failed("none")})
    assert (found.weak, found.similar, found.others) == ((), (), NAMES)
    assert not any(item.wanted for item in found.explode().values())


def test_the_smaller_group_is_weak_and_gets_its_most_similar_images() -> None:
    weakly = CHAIN | {("d", "e"): pair_of(3)}
    found = weak_images(CAPTURE, weakly, partners=1)
    assert found.weak == ("e", "f")
    assert not found.similar  # e and f show the same place, which no other image does
    assert set(weak_images(CAPTURE, weakly, partners=5).similar) == {"a", "b", "c", "d"}
    assert weak_images(CAPTURE, weakly, min_share=0.01).weak == ()


def test_without_any_strong_pair_all_are_weak() -> None:
    assert weak_images(CAPTURE, {("a", "b"): pair_of(4)}).weak == NAMES


def test_a_setting_forces_or_forbids_it() -> None:
    assert weak_images(CAPTURE, CHAIN, learned="always").weak == NAMES
    assert weak_images(CAPTURE, {}, learned="never").others == NAMES


def test_images_are_paired_by_their_learned_descriptors() -> None:
    """The key points of SIFT, which say the opposite, do not count."""
    both = {
        name: joined(features_of(name, place=name in "ace"), features_of(name, place=name in "ef", learned=True))
        for name in NAMES
    }
    assert ("e", "f") in learned_pairs(both, neighbours=1).pairs
    assert len(learned_pairs(both, neighbours=5).pairs) == 15
    both["f"] = both["f"].without_learned()
    assert not any("f" in pair for pair in learned_pairs(both, neighbours=5).pairs)
    assert learned_pairs(CAPTURE).pairs == ()


def test_verified_pairs_of_images_with_learned_key_points_are_compared_again() -> None:
    both = {
        name: joined(features_of(name, place=ord(name)), features_of(name, place=name in "ef", learned=name != "c"))
        for name in NAMES
    }
    matches = {("a", "b"): pair_of(30), ("a", "c"): pair_of(30), ("b", "d"): TwoView.failed("few")}
    plain, found = learned_pairs(both, neighbours=1).pairs, learned_pairs(both, matches, neighbours=1).pairs
    assert {*found} == {*plain, ("a", "b")}
    assert list(found) == sorted(found)


def test_learned_key_points_follow_those_of_sift() -> None:
    first, learned = features_of("a"), features_of("b", learned=True)
    both = joined(first, learned)
    both.check()
    assert (len(both), both.learned) == (600, 300)
    np.testing.assert_array_equal(both.only_learned().bearings, learned.bearings)
    np.testing.assert_array_equal(both.without_learned().descriptors, first.descriptors)
    with pytest.raises(UsageError, match=r"features\.sift_tangent"):
        joined(replace(first, metric="hamming", descriptors=np.zeros((300, 32), np.uint8)), learned)


def test_an_image_without_key_points_is_weak() -> None:
    """Its vector was longer than those of the others, which stopped the stage."""
    capture = {**CAPTURE, "g": CAPTURE["a"].only_learned()}
    assert weak_images(capture, CHAIN).weak == ("g",)
