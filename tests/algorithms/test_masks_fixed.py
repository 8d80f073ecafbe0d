"""Areas of one colour and what moves with the camera are found, and nothing else is taken for them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import areas_of_color, reduced_to_width
from pano_mvs.algorithms.masks.static_content import (
    MIN_VIEWS,
    FrameAgreement,
    color_difference,
    evenly_spread_pairs,
    static_content,
)
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_from_pixel, ray_grid, roll_panorama
from pano_mvs.testing.room import default_room, render
from tests.synthetic.rig import RIGS, with_rig

SMALL_HW = (128, 256)
RAYS = ray_grid(SMALL_HW)


def disc(center: np.ndarray, radius_deg: float) -> np.ndarray:
    return np.asarray(RAYS @ center > np.cos(np.radians(radius_deg)))


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    return render(default_room(), Rigid3.identity(), SMALL_HW, supersample=1)[0]


@pytest.mark.parametrize("pixel", [(128, 64), (0, 64), (30, 0.5), (200, 127.5)])
@pytest.mark.parametrize("color", [(0, 0, 0), (10, 200, 90)])
def test_a_disc_is_found_anywhere_after_compression(
    room: np.ndarray, pixel: tuple[int, float], color: tuple[int, int, int]
) -> None:
    drawn = disc(ray_from_pixel(np.array(pixel), SMALL_HW), 12)
    picture = np.where(drawn[..., None], np.array(color, np.uint8), room)
    compressed = cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1], cv2.IMREAD_COLOR)
    assert compressed is not None
    found = areas_of_color(compressed, color, tolerance=12)
    assert found[drawn].mean() > 0.97
    assert not found[~disc(ray_from_pixel(np.array(pixel), SMALL_HW), 30)].any()


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
    area = np.degrees(1) ** 2 * (pixel_solid_angle(SMALL_HW)[:, None] * ring).sum()
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


SIZE_HW = (256, 512)
CENTERS = [(0.0, 0.0, 0.0), (0.5, 0.1, 0.2), (-0.3, 0.0, 0.6), (0.2, -0.2, -0.5)]
AREA = np.broadcast_to(pixel_solid_angle(SIZE_HW)[:, None], SIZE_HW)


@pytest.fixture(scope="module")
def views() -> list[NDArray[np.uint8]]:
    """Panoramas by cameras that do not turn, so that everything distant stays in place."""
    room = default_room()
    return [render(room, Rigid3.from_center(np.eye(3), np.array(c)), SIZE_HW, supersample=1)[0] for c in CENTERS]


def with_rigs(views: list[NDArray[np.uint8]], name: str) -> tuple[list[NDArray[np.uint8]], NDArray[np.bool_]]:
    drawn = RIGS[name](SIZE_HW)
    rng = np.random.default_rng(3)
    gains = rng.uniform(0.9, 1.1, len(views))
    return [with_rig(view, drawn, gain=g, rng=rng) for view, g in zip(views, gains, strict=True)], drawn[1]


def share(pixels: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(AREA[pixels & of].sum() / AREA[of].sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
def test_rigs_are_found(views: list[NDArray[np.uint8]], name: str) -> None:
    pictures, truth = with_rigs(views, name)
    found = static_content(pictures)
    assert not found.reason
    assert share(found.pixels, truth) > 0.85
    assert share(found.pixels, ~truth) < 0.005


@pytest.mark.parametrize("count", [MIN_VIEWS, len(CENTERS)])
def test_nothing_is_found_without_a_rig(views: list[NDArray[np.uint8]], count: int) -> None:
    found = static_content(views[:count])
    assert not found.reason
    assert not found.pixels.any()


def test_a_distant_background_is_not_taken_for_a_rig(views: list[NDArray[np.uint8]]) -> None:
    """Half of the sphere shows the same in all views, as mountains do, behind a foreground that hides parts of it."""
    far = views[0].copy()
    pictures = []
    for number, view in enumerate(views):
        picture = view.copy()
        skyline = 96 + np.rint(14 * np.sin(np.arange(SIZE_HW[1]) / 15 + 2 * number)).astype(int)
        above = np.arange(SIZE_HW[0])[:, None] < skyline
        picture[above] = far[above]
        pictures.append(picture)
    assert not static_content(pictures).pixels.any()


def test_views_of_one_place_are_refused(views: list[NDArray[np.uint8]]) -> None:
    found = static_content([views[0]] * 4)
    assert "of one place" in found.reason
    assert not found.pixels.any()


def test_two_views_are_too_few(views: list[NDArray[np.uint8]]) -> None:
    assert "3 panoramas" in static_content(views[:2]).reason


def test_tiny_panoramas_are_refused() -> None:
    assert "128 columns" in static_content([np.zeros((32, 64, 3), np.uint8)] * 3).reason


def test_sizes_must_agree() -> None:
    with pytest.raises(UsageError, match="one size"):
        static_content([np.zeros((64, 128, 3), np.uint8), np.zeros((32, 64, 3), np.uint8)])


def test_masked_areas_are_no_evidence(views: list[NDArray[np.uint8]]) -> None:
    pictures, truth = with_rigs(views, "helmet")
    below = np.zeros(SIZE_HW, np.bool_)
    below[170:] = True
    assert truth[~below].sum() == 0
    assert not static_content(pictures, [~below] + [np.ones(SIZE_HW, np.bool_)] * 3).pixels.any()


@pytest.mark.slow
def test_margin_and_area(views: list[NDArray[np.uint8]]) -> None:
    pictures, _ = with_rigs(views, "helmet")
    narrow, wide = (static_content(pictures, margin_deg=margin).pixels for margin in (0.0, 3.0))
    assert (wide | ~narrow).all()
    assert AREA[wide].sum() > 1.1 * AREA[narrow].sum()
    assert not static_content(pictures, min_area_deg2=20_000).pixels.any()


@pytest.mark.slow
def test_sharpness_is_positive_only_where_structure_agrees_exactly(views: list[NDArray[np.uint8]]) -> None:
    shifted = [np.roll(views[0], columns, axis=1) for columns in (0, 1, 2)]
    middle = slice(64, 192)
    textured = FrameAgreement([views[0]] * 3).contrast[middle] > 8
    assert (FrameAgreement([views[0]] * 3).sharpness[middle][textured] > 0).mean() > 0.9
    assert (FrameAgreement(shifted).sharpness[middle][textured] > 0).mean() < 0.05


def test_pairs_are_spread_over_all_views() -> None:
    assert evenly_spread_pairs(3) == [(0, 1), (0, 2), (1, 2)]
    pairs = evenly_spread_pairs(12)
    assert len(set(pairs)) == 24
    assert {view for pair in pairs for view in pair} == set(range(12))


def test_color_difference_is_after_the_gains() -> None:
    pictures = [np.full((8, 16, 3), level, np.uint8) for level in (50, 100, 100)]
    assert color_difference(pictures, np.ones((3, 3))).max() == pytest.approx(50)
    assert color_difference(pictures, np.array([[2.0] * 3, [1.0] * 3, [1.0] * 3])).max() == pytest.approx(0, abs=1e-4)


def test_reduced_panoramas_keep_thin_masks() -> None:
    valid = np.ones((512, 1024), np.bool_)
    valid[100, 200] = False
    picture, small = reduced_to_width(np.zeros((512, 1024, 3), np.uint8), valid)
    assert picture.shape == (256, 512, 3)
    assert np.argwhere(~small).tolist() == [[50, 100]]
