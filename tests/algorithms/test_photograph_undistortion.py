"""Undistorted photographs are those of a pinhole camera."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.photograph_undistortion import undistorted_photograph
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.testing.room import default_room
from tests.synthetic.photograph import render_photograph

SIZE_HW, FOCAL_PX = (90, 120), 100.0
POSE = Rigid3.from_center(rotation_from_rotvec(np.array([0.1, 0.6, -0.2])), np.array([0.2, 0.1, 0.1]))


@pytest.mark.parametrize("radial", [-0.2, 0.15])
def test_the_result_is_what_a_pinhole_camera_shows(radial: float) -> None:
    taken = render_photograph(default_room(), POSE, SIZE_HW, focal_px=FOCAL_PX, radial=radial)
    found, focal_px = undistorted_photograph(taken, focal_px=FOCAL_PX, radial=radial)
    expected = render_photograph(default_room(), POSE, SIZE_HW, focal_px=focal_px).astype(float)
    assert found.shape == taken.shape
    assert np.abs(found - expected).mean() < 0.4 * np.abs(taken - expected).mean()
    moved = np.abs(found[:, 1:] - expected[:, :-1]).mean(), np.abs(found[:, :-1] - expected[:, 1:]).mean()
    assert np.abs(found - expected).mean() < 0.6 * min(moved)


@pytest.mark.parametrize("radial", [-0.25, -0.1, 0.1, 0.4])
@pytest.mark.parametrize("size_hw", [(90, 120), (120, 90)])
def test_every_pixel_is_inside_the_photograph_and_no_field_of_view_is_wasted(
    radial: float, size_hw: tuple[int, int]
) -> None:
    focal_px = undistorted_photograph(np.zeros((*size_hw, 3), np.uint8), focal_px=FOCAL_PX, radial=radial)[1]
    half = np.array(size_hw[::-1]) / 2
    sides = np.linspace(-1, 1, 101)
    border = np.concatenate([np.stack([sides, np.ones(101)], axis=1), np.stack([np.ones(101), sides], axis=1)])
    plane = border * half / focal_px
    seen = np.abs(FOCAL_PX * plane * (1 + radial * (plane**2).sum(axis=1, keepdims=True))) / half
    assert seen.max() <= 1 + 1e-9
    assert seen.max() > 1 - 1e-9


@pytest.mark.parametrize(("taken_px", "radial"), [(60.0, -0.5), (100.0, -0.5)])
def test_strong_distortion_does_not_fold_the_result(taken_px: float, radial: float) -> None:
    focal_px = undistorted_photograph(np.zeros((*SIZE_HW, 3), np.uint8), focal_px=taken_px, radial=radial)[1]
    radii = np.linspace(0, np.hypot(*SIZE_HW) / 2 / focal_px, 100)
    assert (np.diff(radii * (1 + radial * radii**2)) > 0).all()
    assert radii[-1] > 0.98 / np.sqrt(-3 * radial)  # as far as it can be used


def test_a_pinhole_photograph_stays_as_it_is() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (8, 9, 3), np.uint8)
    found, focal_px = undistorted_photograph(picture, focal_px=12.0, radial=0.0)
    assert found is picture
    assert focal_px == 12.0
