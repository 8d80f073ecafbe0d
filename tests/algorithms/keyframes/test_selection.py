"""Keyframes follow the motion of the camera, not the time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from pano_mvs.algorithms.keyframes import KeyframeSettings, SmallFrame, select_keyframes
from tests.algorithms.keyframes.walked_room import PER_S, frames_along, grey_from

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


def test_a_camera_that_stands_and_turns_gives_one_frame() -> None:
    assert numbers(chosen(np.zeros(40))).tolist() == [0]
    assert numbers(chosen(np.zeros(40), yaws(np.arange(40) * 9.0))).tolist() == [0]


def test_a_walk_that_stops_gives_no_frames_while_it_stands() -> None:
    places = np.concatenate([np.linspace(-0.9, 0, 15), np.zeros(25), np.linspace(0, 0.9, 15)])
    found = numbers(chosen(places, yaws(np.concatenate([np.zeros(20), np.linspace(0, 180, 35)]))))
    standing = (found > 18) & (found < 39)
    assert standing.sum() <= 1
    assert 4 <= len(found) <= 7
    assert np.diff(places[found]).max() < 0.7


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
