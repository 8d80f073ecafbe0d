"""Learned matches are for images that SIFT does not place firmly, and for those only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pano_mvs.algorithms.learned.aliked import joined
from pano_mvs.algorithms.learned.networks import DESCRIPTOR_NORM
from pano_mvs.algorithms.learned.similar_pairs import learned_pairs
from pano_mvs.algorithms.learned.weak_images import _without_bridges, weak_images
from pano_mvs.algorithms.poses.frame.gauge import no_poses
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.pose_groups import join_groups

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
PLACES = {name: Rigid3.from_center(np.eye(3), np.array([idx, 0.0, idx**2])) for idx, name in enumerate(NAMES)}


def placed(names: str = "abcdef") -> Poses:
    return Poses.without_points({name: PLACES[name] for name in names}, frame="", scale="", metric=False)


def pairs(*names: str) -> dict[tuple[str, str], TwoView]:
    """Pairs that agree with `PLACES`, from names such as "ab"."""
    found = {}
    for first, second in map(tuple, names):
        relative = PLACES[second] @ PLACES[first].inverse()
        direction = relative.translation / np.linalg.norm(relative.translation)
        found[first, second] = replace(pair_of(30), rotation=relative.rotation, direction=direction)
    return found


def weak(matches: Mapping[tuple[str, str], TwoView], poses: Poses | None = None) -> str:
    return "".join(weak_images(CAPTURE, matches, placed() if poses is None else poses).weak)


RING = pairs("ab", "bc", "cd", "de", "ef", "af")


def test_images_that_two_pairs_hold_each_need_nothing() -> None:
    """Few matches were a reason before: of 44 images of a street, 18 were weak that SIFT had placed to 2.5 cm."""
    found = weak_images(CAPTURE, RING | {("a", "c"): TwoView.failed("none")}, placed())
    assert (found.weak, found.similar, found.others) == ((), (), NAMES)
    assert not any(item.wanted for item in found.explode().values())


def test_an_image_without_a_pose_is_weak_and_gets_its_most_similar_images() -> None:
    matches, poses = pairs("ab", "bc", "cd", "ad"), placed("abcd")
    found = weak_images(CAPTURE, matches, poses, partners=1)
    assert found.weak == ("e", "f")
    assert not found.similar  # e and f show the same place, which no other image does
    assert set(weak_images(CAPTURE, matches, poses, partners=5).similar) == {"a", "b", "c", "d"}


def test_an_image_that_hangs_on_one_pair_is_weak() -> None:
    held = pairs("ab", "bc", "cd", "de", "ae")
    assert weak(held | pairs("ef")) == "f"
    assert weak(held | pairs("ef", "df")) == ""


def test_images_behind_one_pair_are_weak_however_well_they_hold_together() -> None:
    """Two rooms that see each other through a door: a cut of one pair is between them."""
    rooms = pairs("ab", "bc", "cd", "ad", "ac", "ef")
    assert weak(rooms | pairs("de")) == "ef"
    assert weak(rooms | pairs("de", "cf")) == ""


def test_images_outside_of_the_group_of_most_are_weak() -> None:
    main, rest = placed("abcd"), placed("ef")
    assert weak(pairs("ab", "bc", "cd", "ad", "ef"), join_groups([main, rest], order=NAMES)) == "ef"
    halves = join_groups([placed("abc"), placed("def")], order=NAMES)
    assert weak(pairs("ab", "bc", "ac", "de", "ef", "df"), halves) == "abcdef"


def test_pairs_that_contradict_the_poses_hold_nothing() -> None:
    turned = {("a", "b"): replace(RING["a", "b"], direction=-RING["a", "b"].direction)}
    assert weak(RING | pairs("bf")) == ""
    assert weak(RING | pairs("bf") | turned) == "a"


def test_an_alternative_geometry_that_agrees_holds_as_well() -> None:
    """Regression: in a hall with a tiled floor, all nine images were weak that SIFT had placed."""
    right = RING["a", "b"]
    among = replace(right, direction=-right.direction).with_alternatives([right])
    assert weak(RING | {("a", "b"): among}) == ""


def test_a_doubt_is_no_reason() -> None:
    """Where structure repeats, networks are deceived, too: of nine right cameras of a hall, two became wrong."""
    assert weak(RING, replace(placed(), doubts={"c": "the place repeats"})) == ""


def test_without_any_pose_all_are_weak() -> None:
    assert weak({}, no_poses(dict.fromkeys(NAMES, "no pair"))) == "abcdef"


@pytest.mark.parametrize(("names", "of_both"), [("ab", ""), ("abc", "abc")])
def test_two_images_have_one_pair_to_hold_them_and_three_have_more(names: str, of_both: str) -> None:
    capture = {name: CAPTURE[name] for name in names}
    chain = pairs(*(first + second for first, second in pairwise(names)))
    assert "".join(weak_images(capture, chain, placed(names)).weak) == of_both


def test_a_setting_forces_or_forbids_it() -> None:
    assert weak_images(CAPTURE, RING, placed(), learned="always").weak == NAMES
    assert weak_images(CAPTURE, {}, placed(), learned="never").others == NAMES


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
    assert weak_images(capture, RING, placed()).weak == ("g",)


def test_a_bridge_between_two_firm_parts_makes_the_smaller_one_weak() -> None:
    assert weak(pairs("ab", "bc", "cd", "ad", "de", "ef")) == "ef"
    chain = list(pairwise(range(600)))
    assert _without_bridges(chain, 600) == []
    assert _without_bridges([*chain, (0, 599)], 600) == sorted([*chain, (0, 599)])
    two_rings = [(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (4, 5), (3, 5)]
    assert _without_bridges(two_rings, 7) == [edge for edge in sorted(two_rings) if edge != (2, 3)]
