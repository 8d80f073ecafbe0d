"""Weak pixels beside confirmed ones of the same surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.bilateral_solver import fast_bilateral_solver
from pano_mvs.algorithms.filters.supported import supported_pixels
from pano_mvs.scene import RangeMap

SIZE = 32, 64
CONFIRMED, WEAK, FILLED = 200, 100, 40


def _grating() -> tuple[RangeMap, NDArray[np.uint8]]:
    """Return dark bars at range 1, confirmed, before a bright wall at range 2, of which little is confirmed."""
    guide = np.full((*SIZE, 3), 200, np.uint8)
    ranges, confidence = np.full(SIZE, 2.0, np.float32), np.full(SIZE, WEAK, np.uint8)
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
    noisy = np.where(supported, range_map.range * rng.uniform(0.995, 1.005, SIZE), range_map.range).astype(np.float32)
    kept = fast_bilateral_solver(RangeMap(noisy, range_map.confidence), guide)
    np.testing.assert_array_equal(kept.range[supported], noisy[supported])
    np.testing.assert_array_equal(kept.confidence, range_map.confidence)
    smoothed = fast_bilateral_solver(RangeMap(noisy, range_map.confidence), guide, keep_supported=False)
    assert (smoothed.range[supported] != noisy[supported]).mean() > 0.9


def test_nothing_is_supported_in_a_map_without_confirmed_pixels() -> None:
    range_map, guide = _grating()
    unchecked = RangeMap(range_map.range, np.full(SIZE, WEAK, np.uint8))
    assert not supported_pixels(unchecked, guide, min_confidence=128).any()
