"""Models whose cameras the images place, with pictures of the synthetic room."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import NoReturn

import cv2
import numpy as np
import pytest

from pano_mvs.algorithms.poses.growth import grown_model
from pano_mvs.algorithms.poses.growth_by_images import extend_by_images, is_ambiguous, model_by_images, repeats
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel, pairs_of
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec
from pano_mvs.scene import Features, TwoView
from pano_mvs.testing.room import default_room, range_along
from tests.algorithms.poses.aliased_capture import same_matches, view_of
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings
from tests.algorithms.room_pictures import SIZE_HW, WHOLE, Vector, room_capture, room_matches
from tools.benchmarks.belief.families import draw
from tools.benchmarks.belief.measuring import matched
from tools.benchmarks.poses.placements import judge_placements

POSES, PICTURES = room_capture()
ALL = range(len(POSES))
AWAY: Vector = (0.5, 0.0, -0.4)


def confirmation() -> Confirmation:
    return Confirmation(lambda image: (PICTURES[image], WHOLE))


def misplaced(model: PlacedModel) -> list[int]:
    """Return the cameras whose direction from the first one is off by more than 3° of the true one."""
    first = POSES[0]
    found = []
    for image, pose in model.cameras.items():
        if image != 0:
            true, own = (each @ base.inverse() for each, base in ((POSES[image], first), (pose, model.cameras[0])))
            cosine = true.center @ own.center / np.linalg.norm(true.center) / np.linalg.norm(own.center)
            if cosine < np.cos(np.deg2rad(3.0)):
                found.append(image)
    return found


@pytest.mark.slow
def test_the_images_place_a_camera_that_most_matches_put_elsewhere() -> None:
    features, views = room_matches({4: AWAY}, false=200)
    pairs = pairs_of(features, views)
    by_pairs, _ = grown_model(pairs, ALL, adjust=True)
    by_images, refused = model_by_images(pairs, ALL, confirmation=confirmation(), adjust=True)
    assert misplaced(by_pairs) == [4]
    assert len(by_images.cameras) == len(POSES)
    assert not misplaced(by_images)
    assert not refused


def test_two_models_are_one_arrangement_whatever_their_frames_and_units_are() -> None:
    features, views = room_matches({})
    model = grown_model(pairs_of(features, views), ALL, adjust=True)[0]
    into_other = Similarity3(3.0, rotation_from_rotvec((0.1, 0.7, -0.2)), np.array([1.0, 2.0, 3.0]))
    other = model.with_cameras({image: into_other.move_camera(pose) for image, pose in model.cameras.items()})
    assert model.is_same_arrangement(other)
    moved = {**model.cameras, 4: Rigid3.from_center(model.cameras[4].rotation, model.cameras[4].center + 0.5)}
    assert not model.is_same_arrangement(model.with_cameras(moved))
    fewer = {image: pose for image, pose in model.cameras.items() if image != 4}
    assert not model.is_same_arrangement(model.with_cameras(fewer))


def pairs_without_common_points() -> tuple[dict[str, Features], dict[tuple[str, str], TwoView]]:
    """Return pairs that have no key point in common with each other, so that matches leave all lengths open."""
    rng = np.random.default_rng(3)
    edges = list(combinations(ALL, 2))
    rays = rng.normal(size=(len(edges), 40, 3))
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    seen = rays * range_along(default_room(), np.zeros(3), rays.reshape(-1, 3)).reshape(len(edges), 40, 1)
    features = {
        f"{image}.png": features_from_bearings(noisy_bearings(rng, POSES[image], seen.reshape(-1, 3), noise_deg=0.05))
        for image in ALL
    }
    names = tuple(features)
    views = {
        (names[i], names[j]): view_of(POSES[j] @ POSES[i].inverse(), same_matches(40, 40 * number))
        for number, (i, j) in enumerate(edges)
    }
    return features, views


@pytest.mark.slow
def test_small_range_maps_give_the_lengths_that_no_third_image_does() -> None:
    features, views = pairs_without_common_points()
    pairs = pairs_of(features, {pair: view for pair, view in views.items() if "0.png" in pair})  # no rays to intersect
    model = PlacedModel(pairs)
    model.seed((0, 1), 0)
    assert not model.copy().place(2)[1]
    left = {2, 3, 4}
    refused = extend_by_images(model, left, confirmation(), adjust=True)
    assert not refused
    assert not left
    assert not misplaced(model)
    unit = np.linalg.norm(POSES[1].center - POSES[0].center)
    for image in (2, 3, 4):
        expected = np.linalg.norm(POSES[image].center - POSES[0].center) / unit
        assert np.linalg.norm(model.cameras[image].center) == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_an_image_whose_places_nothing_confirms_is_left_out_with_the_reason() -> None:
    features, views = room_matches()
    shuffled = [*PICTURES[:4], PICTURES[4][:, ::-1].copy()]
    asked = Confirmation(lambda image: (shuffled[image], WHOLE))
    model = PlacedModel(pairs_of(features, views))
    model.seed((0, 1), 0)
    left = {2, 3, 4}
    refused = extend_by_images(model, left, asked, adjust=True)
    assert left == {4}
    assert set(model.cameras) == {0, 1, 2, 3}
    assert "confirm nothing" in refused[4]


@pytest.mark.slow
def test_pictures_without_texture_leave_the_decision_to_the_pairs() -> None:
    features, views = room_matches({4: AWAY})
    pairs = pairs_of(features, views)
    plain = Confirmation(lambda image: (np.full((32, 64, 3), 90, np.uint8), np.ones((32, 64), np.bool_)), width_px=64)
    by_images, _ = model_by_images(pairs, ALL, confirmation=plain, adjust=True)
    by_pairs, _ = grown_model(pairs, ALL, adjust=True)
    assert by_images.cameras.keys() == by_pairs.cameras.keys()
    for image, pose in by_pairs.cameras.items():
        np.testing.assert_array_equal(by_images.cameras[image].rotation, pose.rotation)


def test_a_pair_is_ambiguous_if_its_second_geometry_is_a_rival() -> None:
    features, views = room_matches({4: AWAY})
    pairs = pairs_of(features, views)
    assert not is_ambiguous(pairs.geometries[0, 1])
    assert is_ambiguous(pairs.geometries[0, 4])
    few = replace(pairs.geometries[0, 4][1], weight=0.2 * pairs.geometries[0, 4][0].weight)
    assert not is_ambiguous((pairs.geometries[0, 4][0], few))


def test_a_place_repeats_if_a_third_of_the_pairs_are_ambiguous() -> None:
    pairs = pairs_of(*room_matches({4: AWAY}), consistent=False)
    assert repeats(pairs, pairs)  # 4 of 10
    edges = [edge for edge in pairs.geometries if edge != (0, 4)]
    three = replace(pairs, geometries={edge: pairs.geometries[edge] for edge in edges})
    assert repeats(three, three)  # 3 of 9
    two = replace(three, geometries={edge: found for edge, found in three.geometries.items() if edge != (1, 4)})
    assert not repeats(two, two)  # 2 of 8
    nothing = Pairs(pairs.features, {})
    assert not repeats(nothing, nothing)


def test_a_place_repeats_if_a_third_of_the_pairs_contradict_others() -> None:
    pairs = pairs_of(*room_matches(), consistent=False)
    assert not repeats(pairs, pairs)
    kept = [edge for edge in pairs.geometries if edge not in ((0, 1), (0, 2), (0, 3), (0, 4))]
    assert repeats(pairs, replace(pairs, geometries={edge: pairs.geometries[edge] for edge in kept}))


def test_where_nothing_repeats_no_image_is_loaded() -> None:
    """The pairs decide, and a sweep of each place costs more than all of the matching."""

    def load(name: str) -> NoReturn:
        raise AssertionError("nobody should look at the images")

    features, views = room_matches()
    poses = solve_scaled_translation(features, views, load=load, rng=np.random.default_rng(0))
    assert len(poses.names) == len(POSES)


@pytest.mark.slow
def test_false_pairs_of_distant_views_do_not_outvote_right_ones() -> None:
    """Regression: four views of a hall fell into two groups."""
    capture = draw("hall", 9101)
    features, views = matched(capture, learned=False)

    def load(name: str) -> Picture:
        """Return a smaller picture than that of the key points: the sweeps take most of the time."""
        small = cv2.resize(capture.pictures[name], SIZE_HW[::-1], interpolation=cv2.INTER_AREA)
        return small.astype(np.uint8), WHOLE

    solved = solve_scaled_translation(features, views, load=load, rng=np.random.default_rng(1))
    found = verify_poses(solved, load, features=features, two_views=views)
    placed = judge_placements(found, capture.truth)
    assert len(found.worlds) == 1
    assert placed.right.sum() == 4
    assert not placed.doubted.any()
