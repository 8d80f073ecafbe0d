"""No border exists: what is resampled is the sphere, not a picture."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import (
    pad_panorama,
    pixel_from_ray,
    ray_from_pixel,
    ray_grid,
    roll_panorama,
    rotate_panorama,
    rotation_from_rotvec,
    sample_panorama,
)
from tests.geometry.strategies import ROTATIONS, UNITS

SIZE = (32, 64)


def smooth(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """A function on the sphere that is no symmetry's: any crack in its panorama shows."""
    x, y, z = np.moveaxis(np.asarray(rays), -1, 0)
    return np.stack([x + 2 * y - 0.5 * z, x * y + z**2 - 0.3 * x], axis=-1)


PANORAMA = smooth(ray_grid(SIZE))
NOISE = np.random.default_rng(8).normal(size=SIZE)
HALF_PIXEL_ERROR = 0.02  # bilinear interpolation of `smooth` at this size


@pytest.mark.parametrize("pad", [0, 1, 7, 32])
def test_the_margin_continues_over_seam_and_poles(pad: int) -> None:
    padded = pad_panorama(NOISE, pad)
    assert padded.shape == (32 + 2 * pad, 64 + 2 * pad)
    for row in range(-pad, 32 + pad):
        # Row −1 lies beyond the zenith: it is row 0 half a turn further on.
        inside = -1 - row if row < 0 else 63 - row if row > 31 else row
        turn = 0 if inside == row else 32
        expected = NOISE[inside, (np.arange(-pad, 64 + pad) + turn) % 64]
        np.testing.assert_array_equal(padded[row + pad], expected)


@pytest.mark.parametrize(("shape", "pad"), [((4, 7), 1), ((4, 8), 5), ((4, 8), -1)])
def test_margins_that_do_not_exist_are_refused(shape: tuple[int, int], pad: int) -> None:
    with pytest.raises(UsageError, match="cannot pad"):
        pad_panorama(np.zeros(shape), pad)


def test_samples_at_pixel_centres_are_the_pixels() -> None:
    y, x = np.mgrid[0:32, 0:64] + 0.5
    np.testing.assert_array_equal(sample_panorama(NOISE, np.stack([x, y], axis=-1)), NOISE)
    np.testing.assert_array_equal(sample_panorama(NOISE, np.stack([x - 64, y], axis=-1)), NOISE)


@given(UNITS)
def test_samples_anywhere_are_those_of_the_sphere(ray: NDArray[np.float64]) -> None:
    sampled = sample_panorama(PANORAMA, pixel_from_ray(ray, SIZE))
    assert sampled == pytest.approx(smooth(ray), abs=HALF_PIXEL_ERROR)


@given(st.floats(0, 64), st.floats(0, 32))
def test_the_seam_wraps(x: float, y: float) -> None:
    here = sample_panorama(NOISE, (x, y))
    for turns in (-2, -1, 1):
        assert sample_panorama(NOISE, (x + 64 * turns, y)) == pytest.approx(here, abs=1e-9)


def test_positions_beyond_the_poles_are_taken_to_the_pole() -> None:
    above, below = sample_panorama(NOISE, [[5, -3], [5, 40]])
    assert above == sample_panorama(NOISE, (5, 0))
    assert below == sample_panorama(NOISE, (5, 32))


def test_the_last_pixel_before_the_seam_has_the_first_beside_it() -> None:
    just_left = np.nextafter(0, -1)  # which the modulo rounds to the full width
    assert sample_panorama(NOISE, (just_left, 10.5)) == pytest.approx(NOISE[10, [-1, 0]].mean())
    assert sample_panorama(NOISE, (64, 10.5)) == pytest.approx(NOISE[10, [-1, 0]].mean())


@given(st.floats(0, 64), st.sampled_from([0, 32]))
def test_a_pole_is_the_same_point_from_both_sides(x: float, y: int) -> None:
    assert sample_panorama(NOISE, (x, y)) == pytest.approx(sample_panorama(NOISE, (x + 32, y)), abs=1e-9)


def test_a_nan_spoils_only_the_samples_that_need_it() -> None:
    holed = NOISE.copy()
    holed[10, 20] = np.nan
    samples = sample_panorama(
        holed, [[20.5, 10.5], [20.9, 10.5], [21.5, 10.5], [21.5, 11.2], [19.49, 10.5], [20.5, 9.5]]
    )
    assert np.isnan(samples).tolist() == [True, True, False, False, False, False]


@pytest.mark.slow
@given(ROTATIONS)
@settings(max_examples=30, deadline=None)
def test_turning_the_camera_turns_the_sphere(new_from_old: NDArray[np.float64]) -> None:
    turned = rotate_panorama(PANORAMA, new_from_old)
    assert turned == pytest.approx(smooth(ray_grid(SIZE) @ new_from_old), abs=HALF_PIXEL_ERROR)


@pytest.mark.parametrize("columns", [0, 1, 32, 63, -7, 200])
def test_a_roll_is_a_turn_about_the_vertical(columns: int) -> None:
    rolled, new_from_old = roll_panorama(NOISE, columns)
    np.testing.assert_array_equal(rolled, np.roll(NOISE, columns, axis=1))
    assert rotate_panorama(NOISE, new_from_old) == pytest.approx(rolled, abs=1e-9)
    ray = ray_from_pixel((5.5, 3.5), SIZE)
    assert new_from_old @ ray == pytest.approx(ray_from_pixel((5.5 + columns, 3.5), SIZE), abs=1e-12)


def test_integers_are_rounded_and_keep_their_type() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (16, 32, 3)).astype(np.uint8)
    turned = rotate_panorama(picture, rotation_from_rotvec((0, 0.3, 0)))
    assert turned.dtype == np.uint8
    exact = rotate_panorama(picture.astype(float), rotation_from_rotvec((0, 0.3, 0)))
    assert np.abs(turned - exact).max() <= 0.5 + 1e-9
