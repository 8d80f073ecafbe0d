"""Median, Gaussian, speckles and fill: laws, recovery, and equality with the slow versions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pano_mvs.algorithms.filters.fill import fill_from_neighbours
from pano_mvs.algorithms.filters.smoothing import gaussian_range, median_range
from pano_mvs.algorithms.filters.speckle import remove_speckles
from pano_mvs.algorithms.panoramas import columns_per_step
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import RangeMap
from tests.algorithms.range_scenes import TRUSTED, as_map, random_map, rolled
from tests.oracles import range_filters as oracle

SIZE = (24, 48)
FILTERS: dict[str, Callable[[RangeMap], RangeMap]] = {
    "median": median_range,
    "median_7": lambda range_map: median_range(range_map, window=7),
    "gaussian": gaussian_range,
    "speckle": lambda range_map: remove_speckles(range_map, max_size_px=4, max_relative_step=0.5),
    "fill": lambda range_map: fill_from_neighbours(range_map, max_distance_px=6, max_hole_deg=0),
}


@pytest.mark.parametrize("name", FILTERS)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000), columns=st.integers(-60, 60))
def test_rolling_the_input_rolls_the_output(name: str, seed: int, columns: int) -> None:
    range_map = random_map(np.random.default_rng(seed), SIZE)
    filtered = FILTERS[name](range_map)
    filtered.check()
    expected, got = rolled(filtered, columns), FILTERS[name](rolled(range_map, columns))
    np.testing.assert_allclose(got.range, expected.range, rtol=1e-6)
    np.testing.assert_array_equal(got.confidence, expected.confidence)


@pytest.mark.parametrize("window", [3, 5, 7])
@pytest.mark.parametrize("holes", [0.0, 0.2, 0.9])
def test_median_equals_the_sorted_window(window: int, holes: float) -> None:
    range_map = random_map(np.random.default_rng(window), SIZE, holes)
    np.testing.assert_array_equal(median_range(range_map, window=window).range, oracle.median(range_map.range, window))


def test_gaussian_equals_the_plain_convolution() -> None:
    range_map = random_map(np.random.default_rng(5), SIZE)
    np.testing.assert_allclose(gaussian_range(range_map).range, oracle.gaussian(range_map.range, 5, 1.1), rtol=1e-6)


@pytest.mark.parametrize("filtered", [median_range, gaussian_range])
def test_invalid_pixels_stay_invalid_and_no_others_become_so(filtered: Callable[..., Any]) -> None:
    range_map = random_map(np.random.default_rng(6), SIZE, holes=0.7)
    np.testing.assert_array_equal(filtered(range_map).valid, range_map.valid)


@pytest.mark.kernel("filters.kernels_fill")
@pytest.mark.parametrize("step", [0.1, 0.5, 2.0])
def test_speckles_are_the_surfaces_that_flooding_finds(step: float) -> None:
    range_map = random_map(np.random.default_rng(7), SIZE)
    labels = oracle.surfaces(range_map.range, step)
    area = np.broadcast_to(pixel_solid_angle(SIZE)[:, None], SIZE) / (2 * np.pi**2 / np.prod(SIZE))
    size = np.array([area[labels == label].sum() if label >= 0 else 0 for label in labels.ravel()]).reshape(SIZE)
    cleaned = remove_speckles(range_map, max_size_px=5, max_relative_step=step)
    np.testing.assert_array_equal(cleaned.valid, range_map.valid & (size > 5))


def test_a_speckle_goes_and_a_surface_across_the_seam_and_the_pole_stays() -> None:
    ranges = np.full((32, 64), 4.0)
    ranges[20:23, 30:33] = 1.0  # 9 pixels
    ranges[15:20, [62, 63, 0, 1, 2]] = 2.0  # 25 pixels in two parts of 10 and 15
    ranges[:4, [10, 42]] = 2.5  # two strips that meet at the pole, apart from each other too small
    cleaned = remove_speckles(as_map(ranges), max_size_px=1.2).range
    assert np.isfinite(cleaned[20:23, 30:33]).all()
    cleaned = remove_speckles(as_map(ranges), max_size_px=16).range
    assert np.isnan(cleaned[20:23, 30:33]).all()
    assert np.isfinite(cleaned[15:20, [62, 63, 0, 1, 2]]).all()
    area = pixel_solid_angle((32, 64))[:4].sum() / (2 * np.pi**2 / 2048)
    assert np.isfinite(remove_speckles(as_map(ranges), max_size_px=1.5 * area).range[:4, [10, 42]]).all()
    assert np.isnan(remove_speckles(as_map(ranges), max_size_px=2.1 * area).range[:4, [10, 42]]).all()


@pytest.mark.kernel("filters.kernels_fill")
def test_fill_equals_the_plain_paths() -> None:
    range_map = random_map(np.random.default_rng(8), SIZE, holes=0.6)
    trusted = range_map.valid & (range_map.confidence >= 128)
    expected = oracle.fill(range_map.range, trusted, columns_per_step(SIZE, steps=8), 6, 1.25)
    filled = fill_from_neighbours(range_map, max_distance_px=6, max_hole_deg=0)
    new = filled.valid & ~range_map.valid
    np.testing.assert_allclose(filled.range[~range_map.valid], expected[~range_map.valid], rtol=1e-6)
    assert filled.confidence[new].min() >= 1
    assert filled.confidence[new].max() <= 63
    np.testing.assert_array_equal(filled.range[range_map.valid], range_map.range[range_map.valid])


def test_fill_takes_the_background_beside_an_occluder() -> None:
    ranges = np.full((64, 128), 4.0)
    ranges[20:40, 50:70] = 1.0
    ranges[18:42, 70:76] = np.nan  # what another view does not see, right of the near thing
    filled = fill_from_neighbours(as_map(ranges, TRUSTED)).range
    np.testing.assert_allclose(filled[18:42, 70:76], 4.0)


def test_fill_does_not_trust_weak_pixels() -> None:
    ranges = np.full(SIZE, 3.0)
    ranges[10:14, 10:14] = np.nan
    assert not fill_from_neighbours(as_map(ranges, 127), max_hole_deg=0).valid[10:14, 10:14].any()
    assert fill_from_neighbours(as_map(ranges, 128), max_hole_deg=0).valid.all()
