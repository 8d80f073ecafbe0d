"""The equirectangular camera keeps what the conventions page says of it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs import geometry
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import angle_between, pixel_from_ray, pixel_solid_angle, ray_from_pixel, ray_grid, spiral_rays
from tests.geometry.strategies import ANGLES, FEW, SIZES, UNITS

SHARES = st.one_of(st.floats(0, 1), st.sampled_from([0.0, 0.5, 1.0, 1e-12, 1 - 1e-12]))


@pytest.mark.parametrize(
    ("pixel", "ray", "what"),
    [
        ((4, 2), (0, 0, 1), "the middle of the picture is straight ahead, z"),
        ((6, 2), (1, 0, 0), "a quarter turn to the right is x"),
        ((2, 2), (-1, 0, 0), "a quarter turn to the left is −x"),
        ((4, 0), (0, -1, 0), "the upper edge is up, and y points down"),
        ((4, 4), (0, 1, 0), "the lower edge is straight down"),
        ((0, 2), (0, 0, -1), "the left edge is straight behind"),
        ((8, 2), (0, 0, -1), "and so is the right edge"),
    ],
)
def test_the_frame_is_x_right_y_down_z_forward(pixel: tuple[int, int], ray: tuple[int, int, int], what: str) -> None:
    assert ray_from_pixel(pixel, (4, 8)) == pytest.approx(np.array(ray), abs=1e-15), what


def test_the_first_pixels_centre_is_at_one_half() -> None:
    np.testing.assert_array_equal(ray_grid((6, 12))[0, 0], ray_from_pixel((0.5, 0.5), (6, 12)))
    np.testing.assert_array_equal(ray_grid((6, 12))[4, 7], ray_from_pixel((7.5, 4.5), (6, 12)))


@FEW
@given(SIZES, SHARES, SHARES)
def test_azimuth_and_elevation_are_those_of_the_page(size: tuple[int, int], share_x: float, share_y: float) -> None:
    height, width = size
    theta, phi = 2 * np.pi * (share_x - 0.5), np.pi * (0.5 - share_y)
    ray = ray_from_pixel((share_x * width, share_y * height), size)
    expected = (np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta))
    assert ray == pytest.approx(np.array(expected), abs=1e-12)
    assert np.linalg.norm(ray) == pytest.approx(1, abs=1e-15)


@FEW
@given(UNITS)
def test_the_inverse_is_that_of_the_page(ray: NDArray[np.float64]) -> None:
    x, y = pixel_from_ray(ray, (180, 360))
    assert np.radians(x - 180) == pytest.approx(np.arctan2(ray[0], ray[2]), abs=1e-12)
    assert np.radians(90 - y) == pytest.approx(np.arctan2(-ray[1], np.hypot(ray[0], ray[2])), abs=1e-12)


@FEW
@given(SIZES, UNITS, st.floats(1e-6, 1e6))
def test_a_ray_of_any_length_survives_the_round_trip(
    size: tuple[int, int], ray: NDArray[np.float64], length: float
) -> None:
    back = ray_from_pixel(pixel_from_ray(length * ray, size), size)
    assert angle_between(back, ray) < 1e-12


@FEW
@given(SIZES, st.floats(1e-6, 1 - 1e-6), st.floats(1e-3, 1 - 1e-3))
@example((512, 1024), 0.5, 0.5)
def test_a_pixel_survives_the_round_trip(size: tuple[int, int], share_x: float, share_y: float) -> None:
    pixel = np.array([share_x * size[1], share_y * size[0]])
    assert pixel_from_ray(ray_from_pixel(pixel, size), size) == pytest.approx(pixel, abs=1e-9)


@FEW
@given(UNITS)
def test_pixels_lie_within_the_picture(ray: NDArray[np.float64]) -> None:
    x, y = pixel_from_ray(ray, (7, 14))
    assert 0 <= x <= 14
    assert 0 <= y <= 7


@FEW
@given(SIZES)
def test_solid_angles_sum_to_the_whole_sphere(size: tuple[int, int]) -> None:
    areas = pixel_solid_angle(size)
    assert areas.shape == (size[0],)
    assert areas.sum() * size[1] == pytest.approx(4 * np.pi, rel=1e-12)
    assert areas == pytest.approx(areas[::-1], rel=1e-9)


def test_solid_angle_of_a_pixel_is_the_integral_of_the_cosine() -> None:
    elevation = np.pi * (0.5 - (np.arange(180_000) + 0.5) / 180_000)
    by_sum = np.cos(elevation).reshape(18, -1).sum(axis=1) * (np.pi / 180_000) * (2 * np.pi / 36)
    assert pixel_solid_angle((18, 36)) == pytest.approx(by_sum, rel=1e-8)


@FEW
@given(UNITS, UNITS, ANGLES)
def test_angle_between_is_exact_near_zero_and_near_pi(
    first: NDArray[np.float64], second: NDArray[np.float64], angle: float
) -> None:
    axis = np.cross(first, second)
    if np.linalg.norm(axis) < 0.1:
        return
    axis /= np.linalg.norm(axis)
    turned = first * np.cos(angle) + np.cross(axis, first) * np.sin(angle)
    assert angle_between(3 * first, 7 * turned) == pytest.approx(abs(angle), abs=2e-15 + 1e-12 * abs(angle))


def test_angle_between_keeps_the_digits_that_acos_loses() -> None:
    assert angle_between((1, 0, 0), (1, 1e-11, 0)) == pytest.approx(1e-11, rel=1e-9)
    assert angle_between((1, 0, 0), (-1, 1e-11, 0)) == pytest.approx(np.pi - 1e-11, abs=1e-15)


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1)])
def test_a_picture_of_one_row_or_column_is_one(size: tuple[int, int]) -> None:
    assert ray_grid(size)[0, 0] == pytest.approx(ray_from_pixel((0.5, 0.5), size))


@pytest.mark.parametrize("size", [(0, 4), (4, 0), (-1, 4)])
def test_no_camera_has_a_size_without_pixels(size: tuple[int, int]) -> None:
    calls: list[Callable[[tuple[int, int]], object]] = [ray_grid, pixel_solid_angle]
    calls += [partial(ray_from_pixel, (1, 1)), partial(pixel_from_ray, (1, 1, 1))]
    for call in calls:
        with pytest.raises(UsageError, match=f"{size[1]}×{size[0]} pixels has no pixels"):
            call(size)


def test_the_public_names_are_those_that_exist() -> None:
    public = {name for name, value in vars(geometry).items() if (callable(value) or name.isupper()) and name[0] != "_"}
    assert public == set(geometry.__all__)
    assert list(geometry.__all__) == sorted(geometry.__all__, key=lambda name: (not name.isupper(), name))


@pytest.mark.parametrize("count", [1, 2, 100, 1000])
def test_rays_are_of_unit_length(count: int) -> None:
    rays = spiral_rays(count)
    assert rays.shape == (count, 3)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(np.ones(count))


def test_every_band_between_two_heights_has_its_share() -> None:
    heights = spiral_rays(1000)[:, 1]
    shares, _ = np.histogram(heights, 10, (-1, 1))
    assert shares.tolist() == [100] * 10
    assert heights[0] == pytest.approx(0.999)


def test_neighbours_are_about_as_far_apart_as_on_a_lattice_of_triangles() -> None:
    rays = spiral_rays(500)
    cosines = rays @ rays.T
    np.fill_diagonal(cosines, -1)
    nearest = np.arccos(cosines.max(axis=1))
    on_a_lattice = np.sqrt(8 * np.pi / (np.sqrt(3) * 500))
    assert nearest.min() > 0.7 * on_a_lattice
    assert nearest.max() < 1.1 * on_a_lattice
