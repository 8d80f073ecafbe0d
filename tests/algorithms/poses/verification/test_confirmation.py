"""True poses are confirmed by the images and false ones are not; how much is to be expected."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from pano_mvs.algorithms.poses.verification.confirmation import (
    MIN_TEXTURED,
    Confirmation,
    Evidence,
    Picture,
    nearest_cameras,
)
from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec
from tests.algorithms.room_pictures import SIZE_HW, WHOLE, moved, room_capture

POSES, PICTURES = room_capture()
CAMERAS = dict(enumerate(POSES))
LEFT = np.broadcast_to(np.arange(SIZE_HW[1]) < SIZE_HW[1] // 2, SIZE_HW)


def confirmation_of(instead: dict[int, Picture] | None = None) -> Confirmation:
    pictures = {idx: (picture, WHOLE) for idx, picture in enumerate(PICTURES)} | (instead or {})
    return Confirmation(pictures.__getitem__)


@pytest.fixture(scope="module")
def confirmation() -> Confirmation:
    return confirmation_of()


@pytest.mark.slow
@pytest.mark.parametrize("image", [0, 3])
def test_a_true_pose_is_confirmed_and_a_moved_one_is_not(confirmation: Confirmation, image: int) -> None:
    true = confirmation.share(image, POSES[image], CAMERAS)
    assert 0.4 < true <= 1
    for by in ((0.5, 0.0, 0.0), (0.0, 0.0, -0.5)):
        assert confirmation.share(image, moved(POSES[image], by), CAMERAS) < 0.4 * true


def test_a_turned_pose_is_not_confirmed(confirmation: Confirmation) -> None:
    turned = Rigid3.from_center(rotation_from_rotvec([0.0, 0.2, 0.0]) @ POSES[1].rotation, POSES[1].center)
    assert confirmation.share(1, turned, CAMERAS) < 0.4 * confirmation.share(1, POSES[1], CAMERAS)


@pytest.mark.slow
def test_the_pose_of_the_image_among_the_cameras_does_not_count(confirmation: Confirmation) -> None:
    elsewhere = {**CAMERAS, 2: moved(POSES[2], (0.5, 0.0, 0.0))}
    assert confirmation_of().share(2, POSES[2], elsewhere) == confirmation.share(2, POSES[2], CAMERAS)


def test_two_images_confirm_one_another(confirmation: Confirmation) -> None:
    true = confirmation.share(0, POSES[0], {1: POSES[1]})
    assert true > 0.15
    turned = rotation_from_rotvec([0.0, 0.3, 0.0])
    assert confirmation.share(0, Rigid3(turned @ POSES[0].rotation, POSES[0].translation), {1: POSES[1]}) < 0.4 * true


def test_a_similarity_of_the_world_changes_nothing(confirmation: Confirmation) -> None:
    there = Similarity3(40.0, rotation_from_rotvec([0.4, -0.9, 0.2]), np.array([3.0, -100.0, 7.0]))
    world = {idx: there.move_camera(pose) for idx, pose in CAMERAS.items()}
    expected = confirmation.share(3, POSES[3], CAMERAS)
    assert confirmation_of().share(3, world[3], world) == pytest.approx(expected, abs=0.01)


@pytest.mark.slow
def test_masked_pixels_are_neither_asked_nor_believed(confirmation: Confirmation) -> None:
    """What is under the mask may be anything."""
    whole = confirmation.evidence(0, POSES[0], CAMERAS)
    noise = np.where(LEFT[..., None], PICTURES[0], np.random.default_rng(1).integers(0, 256, PICTURES[0].shape))
    halves = [
        confirmation_of({0: (picture, LEFT)}).evidence(0, POSES[0], CAMERAS)
        for picture in (PICTURES[0], noise.astype(np.uint8))
    ]
    for half in halves:
        assert half.textured.sum() == pytest.approx(0.5 * whole.textured.sum(), rel=0.15)
        assert half.share == pytest.approx(whole.share, abs=0.15)
    assert halves[0].share == pytest.approx(halves[1].share, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["all masked", "plain"])
def test_an_image_without_texture_says_nothing(what: str) -> None:
    picture = (PICTURES[0], ~WHOLE) if what == "all masked" else (np.full_like(PICTURES[0], 130), WHOLE)
    assert np.isnan(confirmation_of({0: picture}).share(0, POSES[0], CAMERAS))


def test_a_camera_without_others_says_nothing(confirmation: Confirmation) -> None:
    assert np.isnan(confirmation.share(0, POSES[0], {}))
    assert np.isnan(confirmation.share(0, POSES[0], {0: POSES[0]}))
    assert np.isnan(confirmation.share(0, POSES[0], {1: POSES[0]}))


def test_each_image_is_loaded_once_and_only_when_it_is_needed() -> None:
    loaded: Counter[int] = Counter()

    def load(image: int) -> Picture:
        loaded[image] += 1
        return PICTURES[image], WHOLE

    counting = Confirmation(load)
    assert not loaded
    some = {idx: CAMERAS[idx] for idx in (0, 1, 2)}
    for by in ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0)):
        counting.share(0, moved(POSES[0], by), some)
        counting.share(1, moved(POSES[1], by), some)
    assert loaded == {0: 1, 1: 1, 2: 1}


def test_large_panoramas_are_judged_at_the_same_size(confirmation: Confirmation) -> None:
    large = {
        idx: (np.repeat(np.repeat(one, 2, axis=0), 2, axis=1), np.repeat(np.repeat(WHOLE, 2, axis=0), 2, axis=1))
        for idx, one in enumerate(PICTURES)
    }
    assert confirmation_of(large).small(0).image.shape == (128, 256, 3)
    judged = confirmation_of(large).at_width(SIZE_HW[1])
    assert judged.small(0).image.shape == (*SIZE_HW, 3)
    expected = confirmation.share(0, POSES[0], CAMERAS)
    assert judged.share(0, POSES[0], CAMERAS) == pytest.approx(expected, abs=0.03)


@pytest.mark.slow
def test_maps_that_are_used_again_give_what_fresh_ones_give() -> None:
    three = {idx: CAMERAS[idx] for idx in (0, 1, 2)}
    elsewhere = moved(POSES[0], (0.3, 0.0, 0.0))
    reused = confirmation_of()
    for image, pose in ((0, POSES[0]), (1, POSES[1]), (0, elsewhere), (0, POSES[0]), (0, elsewhere)):
        again = reused.evidence(image, pose, three)
        fresh = confirmation_of().evidence(image, pose, three)
        np.testing.assert_array_equal(again.confirmed, fresh.confirmed)
        np.testing.assert_array_equal(again.textured, fresh.textured)


@pytest.mark.slow
def test_maps_of_nearly_the_same_poses_are_near_enough() -> None:
    reused = confirmation_of()
    reused.share(0, POSES[0], CAMERAS)
    scaled = Similarity3(1.7, np.eye(3), np.zeros(3))
    nearly = {idx: scaled.move_camera(moved(pose, (0.0005 * idx, 0.0, 0.0))) for idx, pose in CAMERAS.items()}
    again, fresh = (one.share(0, nearly[0], nearly) for one in (reused, confirmation_of()))
    assert again == pytest.approx(fresh, abs=0.03)


@pytest.mark.slow
def test_the_number_of_threads_does_not_matter_and_stays() -> None:
    import numba

    before = numba.get_num_threads()
    found = []
    try:
        for threads in {1, numba.config.NUMBA_NUM_THREADS}:
            numba.set_num_threads(threads)
            found.append(confirmation_of().evidence(0, POSES[0], CAMERAS).confirmed.tobytes())
            assert numba.get_num_threads() == threads
            with pytest.raises(KeyError, match="9"):
                confirmation_of().share(9, POSES[0], CAMERAS)
            assert numba.get_num_threads() == threads
    finally:
        numba.set_num_threads(before)
    assert len(set(found)) == 1


def test_nearest_cameras_come_by_distance_without_those_in_the_same_place() -> None:
    line = {idx: Rigid3.from_center(np.eye(3), [x, 0.0, 0.0]) for idx, x in enumerate((3.0, 0.0, 1.0, -1.0, 2.0))}
    assert nearest_cameras(line[1], line) == [2, 3, 4, 0]
    assert nearest_cameras(line[1], line, count=2) == [2, 3]
    assert nearest_cameras(line[1], {}) == []
    assert nearest_cameras(line[1], {1: line[1]}) == []


def evidence_of(textured: dict[int, float], rates: dict[int, float]) -> Evidence:
    """Return evidence with given solid angles and confirmed shares of some classes of parallax."""
    solid_angle, confirmed = np.zeros(10), np.zeros(10)
    for each, angle in textured.items():
        solid_angle[each], confirmed[each] = angle, angle * rates[each]
    return Evidence(solid_angle, confirmed)


RATES = {0: 0.9, 5: 0.2}


def test_a_share_is_expected_class_by_class() -> None:
    """A camera that sees all under a large parallax is to confirm as little of it as others do."""
    others = [evidence_of({0: 8.0, 5: 2.0}, RATES), evidence_of({0: 6.0, 5: 4.0}, RATES)]
    for textured, expected in (({0: 10.0}, 0.9), ({5: 10.0}, 0.2), ({0: 5.0, 5: 5.0}, 0.55)):
        own = evidence_of(textured, {0: 0.0, 5: 0.0})
        assert own.share == 0
        assert own.expected_share(others) == pytest.approx(expected, abs=0.02)


def test_a_class_that_nobody_knows_is_expected_to_be_like_all() -> None:
    others = [evidence_of({0: 8.0, 5: 8.0}, RATES)]
    assert evidence_of({9: 10.0}, {9: 0.0}).expected_share(others) == pytest.approx(0.55)


def test_nothing_is_expected_without_others_or_texture() -> None:
    own, plain = evidence_of({0: 10.0}, RATES), evidence_of({0: 0.5 * MIN_TEXTURED * 4 * np.pi}, RATES)
    assert np.isnan(plain.share)
    assert np.isnan(own.expected_share([]))
    assert np.isnan(own.expected_share([plain]))
    assert np.isnan(plain.expected_share([own]))
    assert own.expected_share([own, plain]) == pytest.approx(0.9)
