"""The compiled sphere equals the plain one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.geometry import (
    PinholeView,
    angle_between,
    kernels_sphere,
    pad_panorama,
    pixel_from_ray,
    ray_from_pixel,
    ray_grid,
    rotation_from_rotvec,
    sample_panorama,
)
from pano_mvs.geometry.positions import positions_in_padded, view_in_padded

pytestmark = pytest.mark.kernel("geometry.kernels_sphere")

SIZES = [(4, 8), (5, 6), (1, 2)]
AXES = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [-0.0, 0, -1], [0, 0, 1e-200], [1e9, 1, 0]]


def drawn_rays() -> NDArray[np.float64]:
    """Return rays along the axes, by the seam, by the poles, and all over the sphere."""
    rng = np.random.default_rng(0)
    by_seam = [[side * 1e-12, y, -1] for side in (-1, 1) for y in (-0.5, 0.0, 0.5)]
    by_pole = [[1e-12 * x, y, 1e-12 * z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    return np.concatenate([AXES, by_seam, by_pole, rng.normal(size=(50, 3))])


def drawn_positions(size_hw: tuple[int, int]) -> NDArray[np.float64]:
    """Return all corners and centres of pixels, the borders of the panorama, and positions all over it."""
    height, width = size_hw
    halves = np.stack(np.meshgrid(np.arange(2 * width + 1) / 2, np.arange(2 * height + 1) / 2), axis=-1).reshape(-1, 2)
    drawn = np.random.default_rng(1).random((50, 2)) * [width, height]
    return np.concatenate([halves, drawn])


@pytest.mark.parametrize("size_hw", SIZES)
def test_pixels_of_rays_equal_the_plain_ones(size_hw: tuple[int, int]) -> None:
    rays = drawn_rays()
    found = [kernels_sphere.pixel_from_ray(*ray, *size_hw) for ray in rays]
    np.testing.assert_allclose(found, pixel_from_ray(rays, size_hw), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("size_hw", SIZES)
def test_angles_of_pixels_are_those_of_their_rays(size_hw: tuple[int, int]) -> None:
    for x, y in drawn_positions(size_hw):
        azimuth = kernels_sphere.azimuth_from_x(x, size_hw[1])
        elevation = kernels_sphere.elevation_from_y(y, size_hw[0])
        ray = np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)
        np.testing.assert_allclose(ray, ray_from_pixel((x, y), size_hw), rtol=0, atol=1e-15)


@pytest.mark.parametrize("size_hw", [(4, 8), (5, 10), (2, 4)])
def test_wrapped_pixels_are_those_of_a_padded_panorama(size_hw: tuple[int, int]) -> None:
    height, width = size_hw
    panorama = np.arange(height * width).reshape(size_hw)
    padded = pad_panorama(panorama, height)
    for row in range(-height, 2 * height):
        for column in range(-height, width + height):
            at = kernels_sphere.wrapped_row(row, height), kernels_sphere.wrapped_column(row, column, height, width)
            assert panorama[at] == padded[row + height, column + height]


@pytest.mark.parametrize("size_hw", SIZES)
def test_bilinear_samples_equal_the_plain_ones(size_hw: tuple[int, int]) -> None:
    panorama = np.random.default_rng(2).random(size_hw if size_hw[1] % 2 == 0 else (size_hw[0], size_hw[1] + 1))
    height, width = panorama.shape
    positions = drawn_positions((height, width))
    found = []
    for x, y in positions:
        row_0, row_1, *columns, weight_x, weight_y = kernels_sphere.corners_at(x, y, height, width)
        rows = row_0, row_0, row_1, row_1
        corners = [panorama[row, column] for row, column in zip(rows, columns, strict=True)]
        found.append(kernels_sphere.bilinear(*corners, weight_x, weight_y))
    np.testing.assert_allclose(found, sample_panorama(panorama, positions), rtol=1e-13, atol=1e-15)


def test_the_pixel_at_a_position_contains_it_and_borders_belong_to_the_panorama() -> None:
    found = [
        kernels_sphere.pixel_at(x, y, 4, 8) for x, y in [(0, 0), (0.99, 0.99), (1, 1), (8, 4), (8.5, 3.5), (-0.5, 2)]
    ]
    assert found == [(0, 0), (0, 0), (1, 1), (3, 0), (3, 0), (2, 7)]
    for y, x in np.argwhere(np.ones((4, 8))):
        pixel = kernels_sphere.pixel_from_ray(*ray_grid((4, 8))[y, x], 4, 8)
        assert kernels_sphere.pixel_at(*pixel, 4, 8) == (y, x)


def test_angles_between_vectors_equal_the_plain_ones() -> None:
    rays = drawn_rays()
    rays = rays[np.linalg.norm(rays, axis=1) > 1e-100]
    for offset in range(4):
        others = np.roll(rays, offset, axis=0)
        found = [kernels_sphere.angle_between(*a, *b) for a, b in zip(rays, others, strict=True)]
        np.testing.assert_allclose(found, angle_between(rays, others), rtol=1e-9, atol=1e-15)


def test_fast_angles_equal_the_plain_ones_to_the_precision_of_float32() -> None:
    rays = drawn_rays().astype(np.float32)
    for x, y, z in rays[np.linalg.norm(rays, axis=1) > 1e-6]:
        level = np.sqrt(x * x + z * z)
        if level > 0:
            expected = np.arctan2(float(x), float(z))
            # Of a ray straight behind, −π and π are the same azimuth.
            found = kernels_sphere.fast_azimuth(x, z)
            assert np.cos(float(found) - expected) == pytest.approx(1, abs=1e-12)
            assert np.sin(float(found) - expected) == pytest.approx(0, abs=1e-6)
        assert kernels_sphere.fast_dip(y, level) == pytest.approx(np.arctan2(float(y), float(level)), abs=1e-6)


def test_the_arc_tangent_without_branches_is_as_exact_as_the_library() -> None:
    values = [0.0, 1e-200, 1e-9, 0.3, 0.66, 0.67, 1.0, 5.0, 1e8]
    for y in [*values, *(-value for value in values)]:
        for x in [*values, *(-value for value in values)]:
            expected = 0.0 if x == y == 0 else math.atan2(y + 0.0, x + 0.0)
            assert kernels_sphere.even_atan2(y, x) == pytest.approx(expected, rel=1e-15, abs=1e-15)


@pytest.mark.parametrize("size_hw", [(4, 8), (512, 1024)])
def test_positions_are_the_pixels_of_rays_as_opencv_counts(size_hw: tuple[int, int]) -> None:
    rays = np.concatenate([drawn_rays(), np.random.default_rng(3).normal(size=(600, 3))])
    found = positions_in_padded(rays.reshape(-1, 1, 3), size_hw, 4)[:, 0]
    off = np.abs(found - (pixel_from_ray(rays, size_hw) + 3.5))
    off[:, 0] = np.minimum(off[:, 0], size_hw[1] - off[:, 0])  # the seam is at either end
    assert off.max() < 1e-7 * size_hw[1]


@pytest.mark.parametrize("rows", [slice(None), slice(3, 9)])
@pytest.mark.parametrize("offset_xy", [(0.5, 0.5), (0.25, 0.75)])
def test_positions_of_a_view_are_those_of_its_rays(rows: slice, offset_xy: tuple[float, float]) -> None:
    rotation = rotation_from_rotvec(np.array([1.2, 0.4, -0.3]))
    view = PinholeView(rotation.T, 5.0, np.array([5.5, 4.0]), (10, 12))
    found = view_in_padded(view, (64, 128), 2, rows=rows, offset_xy=offset_xy)
    expected = positions_in_padded(view.rays(rows, offset_xy=offset_xy), (64, 128), 2)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
