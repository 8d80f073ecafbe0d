"""Which frame of a video is sharp, and which is none that a panorama can be made of."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import sharpness
from pano_mvs.algorithms.stitching import is_dual_fisheye
from pano_mvs.geometry import Rigid3, rotation_from_rotvec, sample_panorama
from pano_mvs.testing.room import default_room, render
from tests.synthetic.scenes import SCENES

SIZE = (128, 256)


@functools.cache
def scene_picture(name: str) -> NDArray[np.uint8]:
    return SCENES[name]().view(0, SIZE, supersample=1)[0]


@pytest.fixture(scope="module")
def room() -> NDArray[np.uint8]:
    return render(default_room(), Rigid3.identity(), SIZE, supersample=1)[0]


@pytest.mark.parametrize("name", sorted(SCENES))
def test_any_scene_is_less_sharp_the_more_it_is_blurred(name: str) -> None:
    picture = scene_picture(name)
    shaken = [sharpness(cv2.blur(picture, (width, 1))) for width in (1, 2, 3, 5, 9)]
    assert shaken == sorted(shaken, reverse=True)
    assert shaken[-1] < shaken[0] / 2


def test_sharpness_is_of_the_sphere_and_not_of_the_exposure(room: NDArray[np.uint8]) -> None:
    for columns in (1, 77, 128):
        assert sharpness(np.roll(room, columns, axis=1)) == pytest.approx(sharpness(room), rel=1e-4)
    assert sharpness((room * 0.5).astype(np.uint8)) == pytest.approx(sharpness(room), rel=0.1)
    poles = room.copy()
    poles[:31] = poles[-31:] = 255
    assert sharpness(poles) == sharpness(room)
    assert sharpness(np.full_like(room, 90)) == 0


def unstitched(picture: NDArray[np.uint8], field_deg: float = 190.0) -> NDArray[np.uint8]:
    """What the two lenses of a camera see: angles from an axis grow with the distance from its circle's centre."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[0]] + 0.5
    right, down = columns / (SIZE[0] / 2) - 1, rows / (SIZE[0] / 2) - 1
    radius = np.hypot(right, down)
    angle = np.deg2rad(field_deg / 2) * radius
    front = np.dstack([np.sin(angle) * right / radius, np.sin(angle) * down / radius, np.cos(angle)])
    halves = []
    for turn in (0, np.pi):
        seen = sample_panorama(picture.astype(np.float32), front @ rotation_from_rotvec((0, turn, 0)).T)
        halves.append(np.where(radius[..., None] <= 0.98, seen, 4))
    return np.concatenate(halves, axis=1).round().astype(np.uint8)


def test_two_fisheyes_are_told_from_any_panorama(room: NDArray[np.uint8]) -> None:
    assert is_dual_fisheye(unstitched(room))
    assert not is_dual_fisheye(room)
    for name in sorted(SCENES):
        assert not is_dual_fisheye(scene_picture(name)), name


def test_black_patches_and_nights_are_no_fisheyes(room: NDArray[np.uint8]) -> None:
    tripod = room.copy()
    tripod[-40:] = 0
    both = tripod.copy()
    both[:20] = 0
    assert not is_dual_fisheye(tripod)
    assert not is_dual_fisheye(both)
    assert not is_dual_fisheye(room // 12)
    assert not is_dual_fisheye(np.zeros_like(room))
