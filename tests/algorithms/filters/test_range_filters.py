"""Filters of range maps: laws, recovery, equality with the slow versions, and what they leave alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.bilateral_solver import fast_bilateral_solver
from pano_mvs.algorithms.filters.consistency import checked_with_agreement
from pano_mvs.algorithms.filters.data_term import confidence_weight, require_confidence
from pano_mvs.algorithms.filters.fill import fill_from_neighbours, large_holes
from pano_mvs.algorithms.filters.guided import GuidedFilter, guided_range
from pano_mvs.algorithms.filters.planes import lay_planes
from pano_mvs.algorithms.filters.smoothing import gaussian_range, median_range, remove_speckles
from pano_mvs.algorithms.filters.supported import supported_pixels
from pano_mvs.algorithms.panoramas import box_spread, box_sum, columns_per_step, largest_channel
from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.core.errors import ContractError, UsageError
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import default_room, render
from tests.algorithms.range_scenes import SEEN, TRUSTED, as_map, random_map, rolled
from tests.known import known
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


COLORS = np.random.default_rng(7).integers(0, 256, (*SIZE, 3), np.uint8)


def window(row: int, column: int, radius: int, size_hw: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The pixels of a window, by the definition: rows over the poles, columns as wide as at the window's centre."""
    height, width = size_hw
    half = min(radius * columns_per_step(size_hw, steps=2 * radius + 1)[row], (width - 1) // 2)
    pixels = []
    for y in range(row - radius, row + radius + 1):
        turn = 0 if 0 <= y < height else width // 2
        inside = -1 - y if y < 0 else 2 * height - 1 - y if y >= height else y
        pixels += [(inside, (x + turn) % width) for x in range(column - half, column + half + 1)]
    return tuple(np.array(pixels).T)


@pytest.mark.parametrize("radius", [1, 4])
@pytest.mark.parametrize("shape", [SIZE, (*SIZE, 2)])
def test_sums_are_those_of_the_windows(radius: int, shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).normal(size=shape)
    plain = [[values[window(y, x, radius, SIZE)].sum(axis=0) for x in range(SIZE[1])] for y in range(SIZE[0])]
    np.testing.assert_allclose(box_sum(values, radius), plain, atol=1e-10)
    other = np.random.default_rng(1).normal(size=shape)
    assert np.sum(box_sum(values, radius) * other) == pytest.approx(np.sum(values * box_spread(other, radius)))


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32])
def test_the_largest_channel_is_the_maximum_of_the_last_axis(dtype: type) -> None:
    values: NDArray[Any] = (np.random.default_rng(0).random((5, 7, 3)) * 100 - 20).astype(dtype)
    found = largest_channel(values)
    assert found.dtype == values.dtype
    np.testing.assert_array_equal(found, values.max(axis=-1))
    np.testing.assert_array_equal(largest_channel(np.array([[1, np.nan, 3]])), [np.nan])


def test_guided_values_are_least_squares_in_every_window() -> None:
    rng = np.random.default_rng(1)
    target, weight = rng.uniform(0.2, 1, SIZE), rng.uniform(0, 1, SIZE) * (rng.random(SIZE) < 0.6)
    radius, epsilon = 2, 10.0
    lines, share = np.zeros((*SIZE, 4)), np.zeros(SIZE)
    holders: dict[tuple[int, ...], list[Any]] = {place: [] for place in np.ndindex(SIZE)}
    for y in range(SIZE[0]):
        for x in range(SIZE[1]):
            at = window(y, x, radius, SIZE)
            for place in zip(*at, strict=True):
                holders[place].append((y, x))
            w, total = weight[at], weight[at].sum()
            design = np.c_[COLORS[at] - 128.0, np.ones(len(w))]
            normal = design.T @ (w[:, None] * design) + epsilon**2 * total * np.diag([1, 1, 1, 0])
            lines[y, x] = np.linalg.solve(normal, design.T @ (w * target[at]))
            share[y, x] = total / len(w)
    holding = {place: tuple(np.array(windows).T) for place, windows in holders.items()}
    guided = GuidedFilter(weight, COLORS.astype(float), radius=radius, epsilon=epsilon)
    values, support = guided.values(target), guided.support
    for y, x in [(0, 0), (0, 30), (5, 47), (12, 20), (23, 3)]:
        at = holding[y, x]
        mean = (share[at][:, None] * lines[at]).sum(axis=0) / share[at].sum()
        assert values[y, x] == pytest.approx(mean @ np.append(COLORS[y, x] - 128.0, 1), rel=1e-6)
        assert support[y, x] == pytest.approx(share[at].mean())


def test_guided_smooths_noise_within_what_looks_alike_and_keeps_edges() -> None:
    image, ranges = render(default_room(texture="weak"), Rigid3.identity(), (96, 192))
    noisy = ranges * (1 + 0.05 * np.random.default_rng(0).standard_normal(ranges.shape)).astype(np.float32)
    inner = np.s_[20:76]
    before, after = (
        np.median(np.abs(found / ranges - 1)[inner])
        for found in (noisy, guided_range(as_map(noisy), image, radius=3, epsilon=8).range)
    )
    assert after < 0.5 * before
    two = np.where(np.arange(192) < 96, 1.0, 3.0) * np.ones((96, 1))
    picture = np.repeat((60 * two[..., None]).astype(np.uint8), 3, axis=-1)
    kept = guided_range(as_map(two), picture, epsilon=1).range
    np.testing.assert_allclose(kept[inner], two[inner], rtol=2e-3)
    flat = guided_range(as_map(two), np.full_like(picture, 90)).range
    assert 1.2 < flat[48, 96] < 2.5, "without an edge in the picture there is none in the ranges"


def test_guided_follows_the_sure_pixels_and_fills_only_when_asked() -> None:
    confidence, ranges = np.full(SIZE, TRUSTED), np.full(SIZE, 2.0)
    ranges[10:13, 20:23], confidence[10:13, 20:23] = 7.0, 70
    ranges[5, 5] = np.nan
    range_map = as_map(ranges, confidence)
    smoothed = guided_range(range_map, COLORS)
    assert np.nanmax(smoothed.range) < 2.3
    assert np.isnan(smoothed.range[5, 5])
    np.testing.assert_array_equal(smoothed.confidence, range_map.confidence)
    filled = guided_range(range_map, COLORS, fill=True)
    assert filled.range[5, 5] == pytest.approx(2.0, rel=0.05)
    assert 1 <= filled.confidence[5, 5] <= 63
    filled.check()


def brute_holes(valid: NDArray[np.bool_], max_hole_deg: float) -> NDArray[np.bool_]:
    """Opening of the hole by a disc, by all pairs of pixels."""
    rays = ray_grid(valid.shape).reshape(-1, 3)
    angle_deg = np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)))
    within = angle_deg <= max_hole_deg / 2
    core = ~np.asarray((within & valid.ravel()[None]).any(axis=1))
    near = np.asarray((within & core[None]).any(axis=1))
    return near.reshape(valid.shape) & ~valid


@pytest.mark.parametrize("diameter", [5.1, 13.3, 40.7, 121.9])  # no two pixels are as far apart as half of these
@pytest.mark.parametrize("share", [0.02, 0.2, 0.5, 0.9])
def test_large_holes_are_the_opening_by_a_disc(diameter: float, share: float) -> None:
    rng = np.random.default_rng(round(100 * share))
    valid = np.kron(rng.random((6, 12)) < share, np.ones((4, 4))) > 0
    assert valid.any()
    np.testing.assert_array_equal(large_holes(valid, diameter), brute_holes(valid, diameter))


def test_rims_of_single_pixels_are_found() -> None:
    valid = np.random.default_rng(5).random(SIZE) < 0.7
    np.testing.assert_array_equal(large_holes(valid, 15.7), brute_holes(valid, 15.7))


def test_no_hole_is_large_at_zero_and_all_is_where_nothing_is_valid() -> None:
    valid = np.zeros(SIZE, bool)
    assert not large_holes(valid, 0).any()
    assert large_holes(valid, 20).all()
    assert not large_holes(~valid, 20).any()
    with pytest.raises(UsageError, match="max_hole_deg"):
        large_holes(valid, -1)


@pytest.mark.parametrize("solve", [fast_bilateral_solver, lambda m, _, **settings: fill_from_neighbours(m, **settings)])
def test_a_sky_stays_a_hole_and_cracks_are_filled(solve: Callable[..., RangeMap]) -> None:
    ranges = np.full((64, 128), 3.0)
    ranges[:20] = np.nan  # all above 34° elevation
    ranges[40:43, 50:53] = np.nan
    ranges[30] = np.nan
    range_map, image = as_map(ranges, TRUSTED), np.full((64, 128, 3), 100, np.uint8)
    filled = solve(range_map, image, max_hole_deg=30)
    np.testing.assert_array_equal(np.isnan(filled.range), np.arange(64)[:, None] * np.ones(128) < 20)
    filled.check()
    everything = solve(range_map, image, max_hole_deg=0)
    assert everything.valid[12:].all()


def test_what_is_confirmed_keeps_its_range_in_the_solver() -> None:
    rng = np.random.default_rng(3)
    confidence = np.where(rng.random(SIZE) < 0.5, TRUSTED, SEEN)
    range_map = as_map(rng.uniform(1, 4, SIZE), confidence)
    plain = np.full((*SIZE, 3), 100, np.uint8)
    solved = fast_bilateral_solver(range_map, plain, smoothness=30)
    sure = confidence == TRUSTED
    np.testing.assert_array_equal(solved.range[sure], range_map.range[sure])
    assert np.mean(solved.range[~sure] == range_map.range[~sure]) < 0.01
    smoothed = fast_bilateral_solver(range_map, plain, smoothness=30, keep_confidence=256)
    assert np.mean(smoothed.range[sure] == range_map.range[sure]) < 0.01
    np.testing.assert_array_equal(smoothed.range[~sure], solved.range[~sure])


@pytest.mark.parametrize("least", [64, 128, 200])
def test_only_what_is_sure_enough_is_left(least: int) -> None:
    range_map = random_map(np.random.default_rng(0), SIZE)
    left = require_confidence(range_map, min_confidence=least)
    left.check()
    np.testing.assert_array_equal(left.valid, range_map.confidence >= least)
    np.testing.assert_array_equal(left.range[left.valid], range_map.range[left.valid])
    assert np.all(np.diff(confidence_weight(np.arange(256, dtype=np.uint8))) > 0)


KEEPING_NORMALS: dict[str, Callable[[RangeMap], RangeMap]] = {
    "median": median_range,
    "gaussian": gaussian_range,
    "speckle": partial(remove_speckles, max_size_px=4, max_relative_step=0.5),
    "fill": partial(fill_from_neighbours, max_distance_px=6),
    "confidence": require_confidence,
    "guided": partial(guided_range, guide=COLORS, radius=2),
    "solver": partial(fast_bilateral_solver, guide=COLORS, sigma_spatial=4),
}


@pytest.mark.parametrize("name", KEEPING_NORMALS)
def test_normals_stay_where_the_range_stayed_and_are_unknown_elsewhere(name: str) -> None:
    range_map = random_map(np.random.default_rng(2), SIZE)
    normals = np.where(range_map.valid[..., None], -ray_grid(SIZE), np.nan).astype(np.float16)
    given = RangeMap(range_map.range, range_map.confidence, normals)
    filtered = KEEPING_NORMALS[name](given)
    filtered.check()
    stayed = filtered.range == range_map.range
    found = known(filtered.normals_in_cam)
    np.testing.assert_array_equal(found[stayed], normals[stayed])
    assert np.isnan(found[~stayed]).all()


@pytest.mark.parametrize("harm", [{"radius": 0}, {"radius": 12}])
def test_bad_settings_are_refused(harm: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=f"{next(iter(harm))} must be"):
        guided_range(as_map(np.ones(SIZE)), COLORS, **harm)
    with pytest.raises(UsageError, match="guide must be"):
        guided_range(as_map(np.ones(SIZE)), COLORS[::2])
    with pytest.raises(UsageError, match="min_confidence"):
        require_confidence(as_map(np.ones(SIZE)), min_confidence=0)


BARS_HW = 32, 64
CONFIRMED, WEAK, FILLED = 200, 100, 40


def _grating() -> tuple[RangeMap, NDArray[np.uint8]]:
    """Return dark bars at range 1, confirmed, before a bright wall at range 2, of which little is confirmed."""
    guide = np.full((*BARS_HW, 3), 200, np.uint8)
    ranges, confidence = np.full(BARS_HW, 2.0, np.float32), np.full(BARS_HW, WEAK, np.uint8)
    guide[:, ::4] = 40
    ranges[:, ::4], confidence[:, ::4] = 1.0, CONFIRMED
    confidence[:, 2::8] = CONFIRMED
    return RangeMap(ranges, confidence), guide


def test_a_weak_pixel_needs_a_confirmed_neighbour_of_its_range_and_colour() -> None:
    range_map, guide = _grating()
    supported = supported_pixels(range_map, guide, min_confidence=128)
    assert supported[:, 1:8:2].mean(axis=0).tolist() == [1, 1, 0, 0]  # two beside the confirmed line, two far from it
    assert not supported[range_map.confidence == CONFIRMED].any()
    other_range = range_map.range.copy()
    other_range[10, 1] = 2.1
    assert not supported_pixels(RangeMap(other_range, range_map.confidence), guide, min_confidence=128)[10, 1]
    guide[12, 1] = 150
    assert not supported_pixels(range_map, guide, min_confidence=128)[12, 1]


def test_neither_plain_nor_filled_pixels_are_supported() -> None:
    range_map, guide = _grating()
    plain = np.full_like(guide, 90)
    range_map.range[:] = 2
    assert not supported_pixels(range_map, plain, min_confidence=128).any()
    filled = np.where(range_map.confidence == WEAK, np.uint8(FILLED), range_map.confidence)
    assert not supported_pixels(RangeMap(range_map.range, filled), guide, min_confidence=128).any()


def test_support_goes_over_the_seam() -> None:
    range_map, guide = _grating()
    supported = supported_pixels(range_map, guide, min_confidence=128)
    rolled = RangeMap(np.roll(range_map.range, 3, 1), np.roll(range_map.confidence, 3, 1))
    np.testing.assert_array_equal(
        supported_pixels(rolled, np.roll(guide, 3, 1), min_confidence=128), np.roll(supported, 3, 1)
    )


def test_the_solver_keeps_what_is_supported() -> None:
    range_map, guide = _grating()
    supported = supported_pixels(range_map, guide, min_confidence=128)
    rng = np.random.default_rng(5)
    noisy = np.where(supported, range_map.range * rng.uniform(0.995, 1.005, BARS_HW), range_map.range).astype(
        np.float32
    )
    kept = fast_bilateral_solver(RangeMap(noisy, range_map.confidence), guide)
    np.testing.assert_array_equal(kept.range[supported], noisy[supported])
    np.testing.assert_array_equal(kept.confidence, range_map.confidence)
    smoothed = fast_bilateral_solver(RangeMap(noisy, range_map.confidence), guide, keep_supported=False)
    assert (smoothed.range[supported] != noisy[supported]).mean() > 0.9


def test_nothing_is_supported_in_a_map_without_confirmed_pixels() -> None:
    range_map, guide = _grating()
    unchecked = RangeMap(range_map.range, np.full(BARS_HW, WEAK, np.uint8))
    assert not supported_pixels(unchecked, guide, min_confidence=128).any()


SIZE_HW = (32, 64)
SKY = np.zeros(SIZE_HW, np.bool_)
SKY[4:14, 20:40] = True
ASIDE = Rigid3(np.eye(3), np.array([0.3, 0.0, 0.0]))
PICTURE, TRUE_RANGES = render(default_room(), Rigid3.identity(), SIZE_HW, supersample=1)
OTHER, _ = render(default_room(), ASIDE, SIZE_HW, supersample=1)


def known_map(sky: NDArray[np.bool_] | None) -> RangeMap:
    return RangeMap(
        np.where(SKY, np.nan, TRUE_RANGES).astype(np.float32), np.where(SKY, 0, 200).astype(np.uint8), sky=sky
    )


ALL_FILTERS: dict[str, Callable[[RangeMap], RangeMap]] = {
    "solver": lambda found: fast_bilateral_solver(found, PICTURE, max_hole_deg=0),
    "fill": lambda found: fill_from_neighbours(found, max_hole_deg=0),
    "planes": lambda found: lay_planes(found, PICTURE, rng=np.random.default_rng(0)),
    "median": median_range,
    "gaussian": gaussian_range,
    "guided": lambda found: guided_range(found, PICTURE),
    "speckle": lambda found: remove_speckles(found, max_size_px=3, max_relative_step=0.3),
    "consistency": lambda found: checked_with_agreement(
        found, Rigid3.identity(), [known_map(None)], source_poses=[ASIDE]
    )[0],
    "patchmatch": lambda found: refine_range(found, PICTURE, [OTHER], source_from_reference=[ASIDE]),
}


@pytest.mark.parametrize("name", ALL_FILTERS)
def test_no_filter_gives_the_sky_a_range(name: str) -> None:
    result = ALL_FILTERS[name](known_map(SKY))
    result.check()
    assert result.sky is not None
    assert np.array_equal(result.sky, SKY)
    assert not result.valid[SKY].any()
    assert result.valid[~SKY].mean() > 0.5


@pytest.mark.parametrize("name", ["solver", "fill"])
def test_without_it_the_same_pixels_are_filled(name: str) -> None:
    assert ALL_FILTERS[name](known_map(None)).valid[SKY].mean() > 0.9


def test_a_range_map_without_a_sky_is_stored_as_before() -> None:
    assert known_map(None).to_parts()["meta"] == {"normals_in_cam": None, "uncertainty": None}
    again = RangeMap.from_parts(known_map(SKY).to_parts())
    assert again.sky is not None
    assert np.array_equal(again.sky, SKY)
    assert RangeMap.from_parts(known_map(None).to_parts()).sky is None


def test_a_sky_with_a_range_is_refused() -> None:
    with pytest.raises(ContractError, match="sky has a range"):
        RangeMap(TRUE_RANGES, np.full(SIZE_HW, 200, np.uint8), sky=SKY).check()
