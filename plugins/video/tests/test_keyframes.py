"""Keyframes follow the parallax of the camera, without its rotation, and not the time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from pano_mvs_video.keyframes import (
    REDUCED_HW,
    KeyframeSettings,
    Motion,
    ParallaxTracker,
    SmallFrame,
    reduced_grey,
    select_keyframes,
)
from walked_room import PER_S, frames_along, grey_from


def motion_to(x: float, turn_deg: tuple[float, float, float] = (0, 0, 0)) -> Motion:
    tracker = ParallaxTracker()
    tracker.anchor(grey_from(0.0))
    return tracker.measure(grey_from(x, turn_deg, seed=1))


@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (0, 15, 0), (0, 110, 0), (0, -170, 0), (20, 40, -10)])
def test_a_camera_that_only_turns_has_no_parallax(turn_deg: tuple[float, float, float]) -> None:
    motion = motion_to(0.0, turn_deg)
    assert motion.seen_share > 0.8
    assert np.degrees(motion.parallax_rad) < 0.2


@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (0, 12, 0), (5, -30, 5)])
def test_parallax_grows_with_the_way_whatever_the_rotation(turn_deg: tuple[float, float, float]) -> None:
    near, far = (np.degrees(motion_to(x, turn_deg).parallax_rad) for x in (0.1, 0.3))
    assert near == pytest.approx(1.85, rel=0.15)
    assert far == pytest.approx(3 * near, rel=0.15)


def test_rotations_add_up_over_frames() -> None:
    tracker = ParallaxTracker()
    tracker.anchor(grey_from(0.0))
    for number in range(1, 15):
        motion = tracker.measure(grey_from(0.0, (3 * np.sin(number), 25.0 * number, 0), seed=number))
        assert np.degrees(motion.parallax_rad) < 0.25
        assert motion.seen_share > 0.8


def test_masked_pixels_are_not_used() -> None:
    """An operator who walks with the camera does not move in the panorama."""
    scene = np.random.default_rng(0)
    operator = scene.integers(0, 255, (REDUCED_HW[0], 160)).astype(np.uint8)
    first, second = (grey_from(x).copy() for x in (0.0, 0.3))
    first[:, :160] = second[:, :160] = operator
    mask = np.ones(REDUCED_HW, np.bool_)
    mask[:, :160] = False
    parallax = []
    for usable in (None, mask):
        tracker = ParallaxTracker(usable)
        tracker.anchor(first)
        parallax.append(float(np.degrees(tracker.measure(second).parallax_rad)))
    assert parallax[0] < 1
    assert parallax[1] > 3


def test_a_plain_frame_has_no_points() -> None:
    tracker = ParallaxTracker()
    assert tracker.points == 0
    assert tracker.measure(grey_from(0.0)) == Motion(0.0, 0.0)


def test_frames_are_reduced_to_one_size() -> None:
    frame = np.full((960, 1920, 3), (0, 0, 255), np.uint8)
    assert reduced_grey(frame).shape == REDUCED_HW
    assert np.unique(reduced_grey(frame)).tolist() == [76]


NORMAL = KeyframeSettings(parallax_deg=8.0, min_s=0.2, max_s=None)


def chosen(
    places: ArrayLike,
    turns_deg: ArrayLike | None = None,
    sharpness: ArrayLike | None = None,
    settings: KeyframeSettings = NORMAL,
) -> list[SmallFrame]:
    return list(select_keyframes(frames_along(places, turns_deg, sharpness), settings))


def numbers(frames: Sequence[SmallFrame]) -> NDArray[np.intp]:
    return np.array([round(frame.time_s * PER_S) for frame in frames], np.intp)


def yaws(angles_deg: ArrayLike) -> NDArray[np.float64]:
    angles = np.asarray(angles_deg, np.float64)
    return np.stack([np.zeros_like(angles), angles, np.zeros_like(angles)], axis=1)


@pytest.mark.slow
def test_a_camera_that_stands_and_turns_gives_one_frame() -> None:
    assert numbers(chosen(np.zeros(40))).tolist() == [0]
    assert numbers(chosen(np.zeros(40), yaws(np.arange(40) * 9.0))).tolist() == [0]


@pytest.mark.slow
def test_a_walk_that_stops_gives_no_frames_while_it_stands() -> None:
    places = np.concatenate([np.linspace(-0.9, 0, 15), np.zeros(25), np.linspace(0, 0.9, 15)])
    found = numbers(chosen(places, yaws(np.concatenate([np.zeros(20), np.linspace(0, 180, 35)]))))
    standing = (found > 18) & (found < 39)
    assert standing.sum() <= 1
    assert 4 <= len(found) <= 7
    assert np.diff(places[found]).max() < 0.7


@pytest.mark.slow
def test_a_fast_walk_gives_more_frames_each_second_and_the_same_for_its_length() -> None:
    slow, fast = np.linspace(-0.9, 0.9, 60), np.linspace(-0.9, 0.9, 20)
    found = [places[numbers(chosen(places))] for places in (slow, fast)]
    assert abs(len(found[0]) - len(found[1])) <= 1
    steps = np.concatenate([np.diff(places) for places in found])
    assert steps[:-1].min() > 0.25
    assert steps.max() < 0.75


def test_sharp_neighbours_are_preferred_to_blurred_frames() -> None:
    places = np.linspace(-0.9, 0.9, 60)
    sharpness = np.where(np.arange(60) % 3 == 1, 1.0, 0.4)
    found = numbers(chosen(places, sharpness=sharpness))
    assert len(found) >= 4
    assert set((found[:-1] % 3).tolist()) == {1}  # only the last one may have no choice


def test_the_minimum_time_holds() -> None:
    settings = KeyframeSettings(parallax_deg=2.0, min_s=0.5, max_s=None)
    found = numbers(chosen(np.linspace(-0.9, 0.9, 40), settings=settings))
    assert np.diff(found).min() >= 5


def test_the_maximum_time_adds_frames_where_the_camera_stands() -> None:
    settings = KeyframeSettings(parallax_deg=8.0, min_s=0.2, max_s=1.0)
    found = numbers(chosen(np.zeros(41), settings=settings))
    assert 4 <= len(found) <= 6
    assert np.diff(found).max() <= 10


def test_a_cut_gives_a_frame() -> None:
    cut = np.concatenate([np.full(15, -0.9), np.full(15, 0.9)])
    frames = [
        SmallFrame(frame.time_s, frame.grey if idx < 15 else 255 - np.roll(frame.grey[::-1], 77, axis=1), 1.0)
        for idx, frame in enumerate(frames_along(cut))
    ]
    found = numbers(list(select_keyframes(frames, NORMAL)))
    assert len(found) == 2
    assert 15 <= found[1] <= 22


def test_without_texture_frames_come_by_time() -> None:
    plain = [SmallFrame(idx / PER_S, np.full((128, 256), 90, np.uint8), 0.0) for idx in range(31)]
    assert numbers(list(select_keyframes(plain, NORMAL))).tolist() == pytest.approx([0, 10, 20, 30], abs=3)


def test_short_and_empty_videos() -> None:
    assert list(select_keyframes([], NORMAL)) == []
    assert len(list(select_keyframes([SmallFrame(0.0, grey_from(0.0), 1.0)], NORMAL))) == 1
