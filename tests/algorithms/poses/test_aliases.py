"""Blocks of cameras that all pairs between them shift alike, and the moves that put them back."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.verification.aliases import (
    Alias,
    _Suggestion,
    _turned_aliases,
    find_aliases,
    labellings,
    moved_cameras,
)
from pano_mvs.evaluation.poses import relative_pose_errors
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
def test_a_shifted_block_and_its_way_back_are_found(block: set[int], tiles: int) -> None:
    capture, model = shifted_block(f"block {sorted(block)}", block, tiles=tiles)
    before = dict(model.cameras)
    aliases = find_aliases(model)
    assert aliases
    error = min(np.linalg.norm(sign * aliases[0].move - tiles * TILE) for sign in (1, -1))
    assert error < 0.05 * np.linalg.norm(tiles * TILE)
    labels = labellings(model, aliases[0])[0]
    moved = {image for image, label in labels.items() if label}
    assert moved in (block, set(range(COUNT)) - block)
    put_back = moved_cameras(model, aliases[0], labels)
    found = {capture.names[image]: pose for image, pose in put_back.items()}
    errors = relative_pose_errors(found, capture.poses)
    assert errors.registered == COUNT
    assert errors.pair_deg.max() < 6
    wrong = {capture.names[image]: pose for image, pose in before.items()}
    assert relative_pose_errors(wrong, capture.poses).pair_deg.max() > 15
    assert model.cameras == before


@pytest.mark.parametrize(("block", "tiles"), BLOCKS)
def test_every_vote_is_across_the_cut_and_points_the_same_way(block: set[int], tiles: int) -> None:
    _, model = shifted_block(f"votes {sorted(block)}", block, tiles=tiles)
    alias = find_aliases(model)[0]
    back = -1.0 if alias.move @ (tiles * TILE) > 0 else 1.0
    for (i, j), signed in alias.signed_weights.items():
        assert (i in block) != (j in block)
        assert np.sign(signed) == (back if j in block else -back)
    assert alias.support == pytest.approx(sum(map(abs, alias.signed_weights.values())))


def test_a_true_model_in_which_nothing_repeats_has_no_alias() -> None:
    assert find_aliases(model_of(aliased_capture("no alias", false={}, views=COUNT))) == []


def test_two_pairs_do_not_make_an_alias() -> None:
    """Errors of single pairs are no block."""
    capture = aliased_capture("two pairs", false={(0, 3): 1, (2, 5): 1}, views=COUNT)
    assert find_aliases(model_of(capture)) == []


def test_a_true_model_in_which_a_block_might_be_shifted_has_the_alias_too() -> None:
    """The false geometries, which were not chosen, suggest the move: the images are to decide."""
    capture, _ = shifted_block("true model", {4, 5, 6})
    aliases = find_aliases(model_of(capture))
    assert abs(abs(aliases[0].move @ TILE) / (TILE @ TILE) - 1) < 0.05


def test_the_unit_of_the_world_does_not_matter() -> None:
    _, model = shifted_block("unit", {4, 5, 6})
    large = PlacedModel(
        model.pairs,
        {image: Rigid3.from_center(pose.rotation, 30 * pose.center) for image, pose in model.cameras.items()},
        dict(model.chosen),
    )
    large.learn_ranges()
    one, other = find_aliases(model), find_aliases(large)
    assert len(one) == len(other)
    np.testing.assert_allclose(other[0].move, 30 * one[0].move, rtol=1e-6, atol=1e-9)
    assert labellings(large, other[0]) == labellings(model, one[0])


def test_labels_move_only_what_they_say() -> None:
    _, model = shifted_block("labels", {4, 5, 6})
    alias = find_aliases(model)[0]
    labels = {image: int(image == 2) for image in model.cameras}
    for image, pose in moved_cameras(model, alias, labels).items():
        np.testing.assert_allclose(pose.center, model.cameras[image].center + (image == 2) * alias.move, atol=1e-12)
        np.testing.assert_array_equal(pose.rotation, model.cameras[image].rotation)


def suggestions_of(motion: Rigid3, rng: np.random.Generator, *, pairs: int, noise: float) -> list[_Suggestion]:
    """Return what some pairs suggest of one motion, half of them of its inverse, and as many random motions."""
    found = []
    for number in range(2 * pairs):
        center = rng.normal(size=3)
        true = motion if number < pairs else Rigid3(rotation_from_rotvec(rng.normal(size=3) * 2), rng.normal(size=3))
        shaken = Rigid3(rotation_from_rotvec(noise * rng.normal(size=3)) @ true.rotation, true.translation)
        found.append(
            _Suggestion(
                (number, number + 1),
                1.0 + 0.1 * rng.random(),
                shaken if number % 2 else shaken.inverse(),
                center,
                true.apply(center) - center,
            )
        )
    return found


@pytest.mark.parametrize("angle_deg", [70.0, 180.0])
def test_a_motion_that_turns_is_found_among_random_ones(angle_deg: float) -> None:
    rng = np.random.default_rng([3, int(angle_deg)])
    turn = rotation_from_rotvec(np.deg2rad(angle_deg) * np.array([0.0, 1.0, 0.0]))
    pivot = np.array([2.0, 0.0, -1.0])
    motion = Rigid3(turn, pivot - turn @ pivot)
    (alias,) = _turned_aliases(suggestions_of(motion, rng, pairs=4, noise=0.005))
    assert set(alias.signed_weights) == {(number, number + 1) for number in range(4)}
    assert alias.own_inverse == (angle_deg == 180)
    found = alias.motion(inverse=bool(alias.signed_weights[1, 2] < 0))
    assert geodesic_angle(found.rotation, turn) < 0.02
    np.testing.assert_allclose(found.apply(pivot), pivot, atol=0.05)
    if not alias.own_inverse:
        assert [np.sign(alias.signed_weights[number, number + 1]) for number in range(4)] in (
            [1, -1, 1, -1],
            [-1, 1, -1, 1],
        )


def test_one_pair_or_random_motions_do_not_make_an_alias_that_turns() -> None:
    rng = np.random.default_rng(4)
    random = suggestions_of(Rigid3.identity(), rng, pairs=6, noise=0.0)[6:]
    assert _turned_aliases(random) == []
    assert _turned_aliases(random[:1]) == []


def test_a_turned_block_is_the_same_whichever_part_has_the_label() -> None:
    _, model = shifted_block("turned", {4, 5, 6})
    turn = rotation_from_rotvec([0.1, 2.0, -0.3])
    alias = Alias(np.array([1.0, -0.5, 2.0]), 1.0, {}, turn)
    inverse = Alias(alias.motion(inverse=True).translation, 1.0, {}, turn.T)
    labels = {image: int(image in {0, 2}) for image in model.cameras}
    block = moved_cameras(model, alias, labels)
    rest = moved_cameras(model, inverse, {image: 1 - label for image, label in labels.items()})
    for image, camera in model.cameras.items():
        points = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 0.0]])
        seen = camera.apply(alias.motion(inverse=True).apply(points)) if labels[image] else camera.apply(points)
        np.testing.assert_allclose(block[image].apply(points), seen, atol=1e-12)
        np.testing.assert_allclose(rest[image].apply(points), seen, atol=1e-12)
