"""The vector kernel for descriptors of whole numbers finds what the plain products find."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.nearest_two import (
    Comparable,
    NearestTwo,
    can_compare_as_integers,
    nearest_two,
)
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR
from tests.algorithms.features.test_matching import features
from tests.oracles.features import match_one_by_one

needs_vector = pytest.mark.skipif(not HAS_VECTOR, reason="no vector instructions, or numba compiles nothing")


def draw(rng: np.random.Generator, count: int, size: int, *, low: int = 0, high: int = 256) -> NDArray[np.float32]:
    return rng.integers(low, high, size=(count, size)).astype(np.float32)


def assert_same(found: NearestTwo, expected: NearestTwo) -> None:
    np.testing.assert_array_equal(found.nearest, expected.nearest)
    np.testing.assert_array_equal(found.squared, expected.squared)
    np.testing.assert_array_equal(found.next_squared, expected.next_squared)
    np.testing.assert_array_equal(found.squared_back, expected.squared_back)


@pytest.mark.kernel("matching.kernels_vector_match")
@needs_vector
@pytest.mark.parametrize("counts", [(1, 2), (6, 64), (7, 65), (5, 63), (130, 517), (401, 129)])
@pytest.mark.parametrize("size", [128, 33])
def test_kernel_equals_the_plain_products(counts: tuple[int, int], size: int) -> None:
    """Counts at and beside full blocks of rows and columns; an odd number of components."""
    rng = np.random.default_rng([*counts, size])
    first, second = (draw(rng, count, size) for count in counts)
    assert_same(Comparable(first).nearest_two(Comparable(second)), nearest_two(first, second))


@pytest.mark.kernel("matching.kernels_vector_match")
@needs_vector
def test_kernel_settles_ties_as_the_plain_products_do() -> None:
    """Hardly any distances differ, so that every row has many nearest ones: the first is taken."""
    rng = np.random.default_rng(8)
    first, second = draw(rng, 90, 4, high=3), draw(rng, 300, 4, high=3)
    expected = nearest_two(first, second)
    assert np.sum(expected.squared == expected.next_squared) > 60
    assert_same(Comparable(first).nearest_two(Comparable(second)), expected)


@pytest.mark.kernel("matching.kernels_vector_match")
@needs_vector
def test_kernel_is_exact_up_to_the_greatest_numbers_that_fit() -> None:
    """Opposite signs make the products most negative; squared distances are beyond what float32 counts singly."""
    rng = np.random.default_rng(9)
    first, second = draw(rng, 40, 128, low=900, high=1025), draw(rng, 70, 128, low=-1024, high=-900)
    assert can_compare_as_integers(first)
    found = Comparable(first).nearest_two(Comparable(second))
    exact = ((first[:, None].astype(np.int64) - second.astype(np.int64)) ** 2).sum(axis=2)
    np.testing.assert_array_equal(found.nearest, exact.argmin(axis=1))
    np.testing.assert_array_equal(found.squared, exact.min(axis=1).astype(np.float32))
    np.testing.assert_array_equal(found.next_squared, np.sort(exact, axis=1)[:, 1].astype(np.float32))
    np.testing.assert_array_equal(found.squared_back, exact.min(axis=0).astype(np.float32))


@pytest.mark.kernel("matching.kernels_vector_match")
@needs_vector
@pytest.mark.parametrize("low", [0, -5])
def test_bytes_and_larger_numbers_are_compared_with_each_other(low: int) -> None:
    rng = np.random.default_rng(11)
    first, second = draw(rng, 70, 128), draw(rng, 90, 128, low=low, high=300)
    assert_same(Comparable(first).nearest_two(Comparable(second)), nearest_two(first, second))
    assert_same(Comparable(second).nearest_two(Comparable(first)), nearest_two(second, first))


@pytest.mark.parametrize("wrong", [0.5, np.nan, np.inf, 2000.0, 1e30])
def test_other_numbers_are_left_to_the_plain_products(wrong: float) -> None:
    descriptors = np.full((3, 128), 7, np.float32)
    assert can_compare_as_integers(descriptors) == HAS_VECTOR
    descriptors[1, 5] = wrong
    assert not can_compare_as_integers(descriptors)


@pytest.mark.parametrize("mutual", [True, False])
@pytest.mark.parametrize("fraction", [0.0, 0.25])
def test_matches_equal_the_plain_search_with_and_without_whole_numbers(mutual: bool, fraction: float) -> None:
    rng = np.random.default_rng(10)
    base = draw(rng, 200, 16, high=120) + np.float32(fraction)
    noisy = base + rng.integers(-12, 13, size=base.shape).astype(np.float32)
    second = np.concatenate([noisy[:100], draw(rng, 100, 16, high=120)])
    found = match_features(features(base), features(second), ratio=0.9, mutual=mutual)
    assert len(found) > 80
    assert [tuple(match) for match in found.tolist()] == match_one_by_one(
        base, second, metric="l2", ratio=0.9, mutual=mutual
    )
