"""Parallax is what remains of the motion of a panorama when the rotation of the camera is removed."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.keyframes import REDUCED_HW, Motion, ParallaxTracker, reduced_grey
from tests.algorithms.keyframes.walked_room import grey_from


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
