"""Blocks of cameras that all pairs between them shift alike: the other arrangement is named."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.verification.aliases import (
    Suggestion,
    _suggestions,
    most_suggested,
    other_arrangement,
)
from pano_mvs.geometry import Rigid3, geodesic_angle, rotation_from_rotvec
from tests.algorithms.poses.aliased_capture import TILE, AliasedCapture, aliased_capture, shifted_pose

COUNT = 7


def shifted_block(name: str, block: set[int], *, tiles: int = 1) -> tuple[AliasedCapture, PlacedModel]:
    """Return a capture and a model of it in which a block of cameras stands some tiles further.

    All pairs across have a false geometry that says so, and the truth as their runner-up.
    """
    false = {
        (i, j): tiles if j in block else -tiles
        for i in range(COUNT)
        for j in range(i + 1, COUNT)
        if (i in block) != (j in block)
    }
    capture = aliased_capture(name, false=false, views=COUNT)
    model = model_of(capture, {one: shifted_pose(capture.poses[capture.names[one]], tiles) for one in block})
    return capture, model


def model_of(capture: AliasedCapture, instead: dict[int, Rigid3] | None = None) -> PlacedModel:
    """Return a model with the true cameras of a capture, or some others instead."""
    poses = dict(enumerate(capture.poses.values())) | (instead or {})
    model = PlacedModel(pairs_of(capture.features, capture.two_views), poses)
    model.choose_again()
    model.learn_ranges()
    model.choose_again()
    return model


BLOCKS = [
    pytest.param({4, 5, 6}, 1, id="the last three"),
    pytest.param({0, 2}, -1, id="two, the first among them"),
    pytest.param({1, 2, 3, 5}, 2, id="most, by two tiles"),
    pytest.param({3}, 1, id="one"),
]


@pytest.mark.parametrize(("block", "tiles"), BLOCKS)
def test_the_motion_of_a_shifted_block_is_found(block: set[int], tiles: int) -> None:
    _, model = shifted_block(f"block {sorted(block)}", block, tiles=tiles)
    edges, one = most_suggested(_suggestions(model))
    assert edges
    assert all((i in block) != (j in block) for i, j in edges)
    assert one is not None
    assert one.length == pytest.approx(float(np.linalg.norm(tiles * TILE)), rel=0.1)
    assert f"{len(edges)} pairs would agree as well if some of the images were" in other_arrangement(model)


def test_a_true_model_in_which_nothing_repeats_has_no_other_arrangement() -> None:
    assert other_arrangement(model_of(aliased_capture("no alias", false={}, views=COUNT))) == ""


def test_a_place_does_not_repeat_because_a_camera_is_wrong() -> None:
    capture = aliased_capture("a wrong camera", false={}, views=COUNT)
    said = other_arrangement(model_of(capture, {3: shifted_pose(capture.poses[capture.names[3]], 1)}))
    assert said.startswith(f"{COUNT - 1} pairs would agree if some of the images were ")


def test_two_pairs_do_not_make_a_block() -> None:
    """Errors of single pairs are no block."""
    capture = aliased_capture("two pairs", false={(0, 3): 1, (2, 5): 1}, views=COUNT)
    assert other_arrangement(model_of(capture)) == ""


def test_a_true_model_in_which_a_block_might_be_shifted_has_the_other_arrangement_too() -> None:
    capture, _ = shifted_block("true model", {4, 5, 6})
    assert other_arrangement(model_of(capture))


def test_the_unit_of_the_world_does_not_matter() -> None:
    _, model = shifted_block("unit", {4, 5, 6})
    large = PlacedModel(
        model.pairs,
        {image: Rigid3.from_center(pose.rotation, 30 * pose.center) for image, pose in model.cameras.items()},
        dict(model.chosen),
    )
    large.learn_ranges()
    (edges, one), (other_edges, other) = (most_suggested(_suggestions(each)) for each in (model, large))
    assert edges == other_edges
    assert one is not None
    assert other is not None
    assert other.length == pytest.approx(30 * one.length, rel=1e-6)


def suggestions_of(motion: Rigid3, rng: np.random.Generator, *, pairs: int, noise: float) -> list[Suggestion]:
    """Return what some pairs suggest of one motion, half of them of its inverse, and as many random motions."""
    found = []
    for number in range(2 * pairs):
        center = rng.normal(size=3)
        true = motion if number < pairs else Rigid3(rotation_from_rotvec(rng.normal(size=3) * 2), rng.normal(size=3))
        shaken = Rigid3(rotation_from_rotvec(noise * rng.normal(size=3)) @ true.rotation, true.translation)
        one = shaken if number % 2 else shaken.inverse()
        moved = float(np.linalg.norm(true.apply(center) - center))
        found.append(Suggestion((number, number + 1), 1.0 + 0.1 * rng.random(), one, center, moved))
    return found


@pytest.mark.parametrize("angle_deg", [70.0, 180.0])
def test_a_motion_that_turns_is_found_among_random_ones(angle_deg: float) -> None:
    rng = np.random.default_rng([3, int(angle_deg)])
    turn = rotation_from_rotvec(np.deg2rad(angle_deg) * np.array([0.0, 1.0, 0.0]))
    pivot = np.array([2.0, 0.0, -1.0])
    edges, one = most_suggested(suggestions_of(Rigid3(turn, pivot - turn @ pivot), rng, pairs=4, noise=0.005))
    assert edges == {(number, number + 1) for number in range(4)}
    assert one is not None
    assert min(geodesic_angle(one.motion.rotation, way) for way in (turn, turn.T)) < 0.03
    np.testing.assert_allclose(one.motion.apply(pivot), pivot, atol=0.1)


def test_one_pair_or_random_motions_do_not_make_an_arrangement() -> None:
    rng = np.random.default_rng(4)
    random = suggestions_of(Rigid3.identity(), rng, pairs=6, noise=0.0)[6:]
    assert most_suggested(random) == (set(), None)
    assert most_suggested(random[:1]) == (set(), None)
    assert most_suggested([]) == (set(), None)
