"""A panorama that is stitched from two lenses shows the room as a panorama that is rendered directly."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.stitching import lens_weights, stitch_lenses
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import LensRig, pixel_solid_angle, ray_grid
from pano_mvs.testing.room import Room, capture_poses, default_room, render
from tests.synthetic.fisheye_rig import example_rig, render_rig

SIZE_HW = (96, 192)
POSE = capture_poses(2)[1]
ROOM = default_room(texture="weak")


@cache
def pictures_of(offset_m: float, size_px: int = 120, ball: bool = False) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    return render_rig(sphere() if ball else ROOM, example_rig(size_px=size_px, offset_m=offset_m), POSE, supersample=1)


def sphere() -> Room:
    """Everything is 2 m away from its middle."""
    return default_room(texture="isotropic")


def test_without_an_offset_it_is_the_panorama() -> None:
    rig = example_rig(size_px=120, offset_m=1e-9)
    panorama, valid = stitch_lenses(pictures_of(1e-9), rig, size_hw=SIZE_HW)
    expected, _ = render(ROOM, POSE, SIZE_HW)
    assert valid.all()
    assert np.abs(panorama.astype(int) - expected).mean() < 2.5


def test_the_stitching_distance_moves_each_lens_to_the_middle() -> None:
    """From the middle of a ball of 2 m, a large offset is invisible at a distance of 2 m, and doubles things at inf."""
    pose = capture_poses(1)[0]
    rig = example_rig(size_px=120, offset_m=0.4)
    pictures = render_rig(sphere(), rig, pose, supersample=1)
    expected, _ = render(sphere(), pose, SIZE_HW)
    errors = []
    for distance in (2.0, np.inf):
        panorama, _ = stitch_lenses(pictures, replace(rig, stitch_distance_m=distance), size_hw=SIZE_HW)
        errors.append(np.abs(panorama.astype(int) - expected).mean())
    assert errors[0] < 20  # the texture is finer than these pixels
    assert errors[1] > 2 * errors[0]


def test_pixels_that_no_lens_sees_are_black_and_invalid() -> None:
    rig = example_rig(size_px=120, field_of_view_deg=150.0)
    pictures = tuple(np.full((120, 120, 3), 200, np.uint8) for _ in range(2))
    panorama, valid = stitch_lenses(pictures, rig, size_hw=SIZE_HW)
    labels = rig.lens_of_bearings(ray_grid(SIZE_HW))
    assert np.array_equal(valid, labels >= 0)
    share = np.average(~valid, weights=np.broadcast_to(pixel_solid_angle(SIZE_HW)[:, None], SIZE_HW))
    assert share == pytest.approx(np.sin(np.radians(15)), abs=0.01)
    assert (panorama[~valid] == 0).all()
    assert (panorama[valid] == 200).all()


def test_outside_of_the_seam_each_pixel_is_that_of_its_lens() -> None:
    rig = example_rig(size_px=120)
    pictures = np.full((120, 120, 3), 50, np.uint8), np.full((120, 120, 3), 150, np.uint8)
    panorama, _ = stitch_lenses(pictures, replace(rig, blend_deg=6.0), size_hw=SIZE_HW)
    labels = rig.lens_of_bearings(ray_grid(SIZE_HW))
    mixed = (panorama[..., 0] > 50) & (panorama[..., 0] < 150)
    assert (panorama[..., 0][~mixed] == np.where(labels == 0, 50, 150)[~mixed]).all()
    assert np.degrees(rig.angle_from_seam(ray_grid(SIZE_HW))[mixed]).max() < 3
    assert np.degrees(rig.angle_from_seam(ray_grid(SIZE_HW))[~mixed]).min() > 2.9
    # A strip of 6° around a great circle is sin 3° of the sphere.
    share = np.average(mixed, weights=np.broadcast_to(pixel_solid_angle(SIZE_HW)[:, None], SIZE_HW))
    assert share == pytest.approx(np.sin(np.radians(3)), rel=0.1)


def test_weights_sum_to_one_where_a_lens_sees() -> None:
    margins = np.array([[0.3, 0.3], [0.3, -np.inf], [-np.inf, 0.1], [-np.inf, -np.inf], [0.5, 0.1], [0.31, 0.29]])
    weights = lens_weights(margins, blend_rad=0.1)
    assert weights == pytest.approx(np.array([[0.5, 0.5], [1, 0], [0, 1], [0, 0], [1, 0], [0.6, 0.4]]))
    assert lens_weights(margins[4:], blend_rad=0.0) == pytest.approx(np.array([[1, 0], [1, 0]]))


def test_large_pictures_are_reduced_without_aliasing() -> None:
    """Stripes of one pixel in pictures of four times the resolution become grey."""
    rig = example_rig(size_px=480)
    stripes = np.zeros((480, 480, 3), np.uint8)
    stripes[::2] = 200
    panorama, _ = stitch_lenses((stripes, stripes), rig, size_hw=SIZE_HW)
    assert np.abs(panorama.astype(int) - 100).max() <= 8


def test_threads_do_not_change_the_result() -> None:
    rig = example_rig(size_px=120, offset_m=0.03, stitch_distance_m=2.0)
    one, many = (stitch_lenses(pictures_of(0.03), rig, size_hw=SIZE_HW, threads=threads)[0] for threads in (1, 3))
    assert np.array_equal(one, many)


def test_pictures_of_another_size_are_refused() -> None:
    rig: LensRig = example_rig(size_px=100)
    with pytest.raises(UsageError, match="the picture of the lens front is"):
        stitch_lenses(pictures_of(0.03), rig, size_hw=SIZE_HW)
