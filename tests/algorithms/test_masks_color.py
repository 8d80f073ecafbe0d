"""Areas of one colour are found on the sphere, and pictures of real things are left alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pano_mvs.algorithms.masks.one_color import areas_of_color
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_from_pixel, ray_grid, roll_panorama
from pano_mvs.testing.room import default_room, render

SIZE_HW = (128, 256)
RAYS = ray_grid(SIZE_HW)


def disc(center: np.ndarray, radius_deg: float) -> np.ndarray:
    return np.asarray(RAYS @ center > np.cos(np.radians(radius_deg)))


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    return render(default_room(), Rigid3.identity(), SIZE_HW, supersample=1)[0]


@pytest.mark.parametrize("pixel", [(128, 64), (0, 64), (30, 0.5), (200, 127.5)])
@pytest.mark.parametrize("color", [(0, 0, 0), (10, 200, 90)])
def test_a_disc_is_found_anywhere_after_compression(
    room: np.ndarray, pixel: tuple[int, float], color: tuple[int, int, int]
) -> None:
    drawn = disc(ray_from_pixel(np.array(pixel), SIZE_HW), 12)
    picture = np.where(drawn[..., None], np.array(color, np.uint8), room)
    compressed = cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1], cv2.IMREAD_COLOR)
    assert compressed is not None
    found = areas_of_color(compressed, color, tolerance=12)
    assert found[drawn].mean() > 0.97
    assert not found[~disc(ray_from_pixel(np.array(pixel), SIZE_HW), 30)].any()


def test_what_is_small_or_of_another_colour_is_left(room: np.ndarray) -> None:
    small = disc(np.array([0.0, 0.0, 1.0]), 1.0)
    assert not areas_of_color(np.where(small[..., None], np.uint8(0), room), (0, 0, 0), min_area_deg2=10).any()
    large = disc(np.array([0.0, 1.0, 0.0]), 20.0)
    grey = np.where(large[..., None], np.uint8(9), room)
    assert not areas_of_color(grey, (0, 0, 0)).any()
    found = areas_of_color(grey, (0, 0, 0), tolerance=9, margin_px=0)
    np.testing.assert_array_equal(found, large)


def test_areas_are_of_the_sphere_not_of_the_grid(room: np.ndarray) -> None:
    """Over the seam, over the poles: rolled pictures give rolled areas, and one area is not two halves."""
    ring = disc(np.array([0.0, 0.0, -1.0]), 1.5)
    area = np.degrees(1) ** 2 * (pixel_solid_angle(SIZE_HW)[:, None] * ring).sum()
    picture = np.where(ring[..., None], np.uint8(0), room)
    assert areas_of_color(picture, (0, 0, 0), min_area_deg2=0.9 * area).any()
    rolled, _ = roll_panorama(picture, 77)
    np.testing.assert_array_equal(
        areas_of_color(rolled, (0, 0, 0), min_area_deg2=0.9 * area),
        np.roll(areas_of_color(picture, (0, 0, 0), min_area_deg2=0.9 * area), 77, axis=1),
    )
    cap = np.where(disc(np.array([0.0, 1.0, 0.0]), 1.5)[..., None], np.uint8(0), room)
    assert areas_of_color(cap, (0, 0, 0), min_area_deg2=0.7 * area).any()


def test_numbers_that_make_no_sense_are_refused(room: np.ndarray) -> None:
    with pytest.raises(UsageError, match="tolerance must be at least 0"):
        areas_of_color(room, (0, 0, 0), tolerance=-1)
    with pytest.raises(UsageError, match="must be \\(H, W, 3\\) uint8"):
        areas_of_color(room[..., 0], (0, 0, 0))
