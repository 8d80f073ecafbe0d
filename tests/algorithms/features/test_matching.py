from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.pair_selection import exhaustive_pairs, sequential_pairs
from pano_mvs.core.errors import UsageError
from pano_mvs.scene import Features
from tests.oracles.features import match_one_by_one


def features(descriptors: NDArray[Any], metric: Literal["l2", "hamming"] = "l2") -> Features:
    count = len(descriptors)
    return Features(
        bearings=np.tile([0.0, 0.0, 1.0], (count, 1)),
        descriptors=descriptors,
        sizes_rad=np.ones(count, np.float32),
        scores=np.ones(count, np.float32),
        colors_rgb=np.zeros((count, 3), np.uint8),
        metric=metric,
        size_hw=(8, 16),
    )


def draw(metric: Literal["l2", "hamming"], seed: int, count: int = 400) -> tuple[Features, Features]:
    """Two sets with a common half, the second's with some noise; more rows than one block."""
    rng = np.random.default_rng(seed)
    if metric == "l2":
        base = rng.integers(0, 120, size=(count, 16)).astype(np.float32)
        noise = rng.integers(-12, 13, size=base.shape).astype(np.float32)
        other = rng.integers(0, 120, size=(count // 2, 16)).astype(np.float32)
        return features(base), features(np.concatenate([(base + noise)[: count // 2], other]))
    bits = rng.integers(0, 256, size=(count, 8), dtype=np.uint8)
    flips = (rng.random((count, 8)) < 0.15).astype(np.uint8)
    others = rng.integers(0, 256, size=(count // 2, 8), dtype=np.uint8)
    return features(bits, metric), features(np.concatenate([(bits ^ flips)[: count // 2], others]), metric)


@pytest.mark.parametrize("metric", ["l2", "hamming"])
@pytest.mark.parametrize("mutual", [True, False])
@pytest.mark.parametrize("ratio", [0.6, 0.9])
def test_equals_the_plain_search(metric: Literal["l2", "hamming"], mutual: bool, ratio: float) -> None:
    first, second = draw(metric, 3)
    found = match_features(first, second, ratio=ratio, mutual=mutual)
    expected = match_one_by_one(first.descriptors, second.descriptors, metric=metric, ratio=ratio, mutual=mutual)
    assert found.dtype == np.int32
    assert len(found) > 100
    assert [tuple(match) for match in found.tolist()] == expected


@pytest.mark.parametrize("metric", ["l2", "hamming"])
def test_mutual_matches_are_one_to_one_even_among_twins(metric: Literal["l2", "hamming"]) -> None:
    first, second = draw(metric, 4)
    doubled = features(np.concatenate([first.descriptors, first.descriptors]), metric)
    for a, b in ((doubled, second), (second, doubled), (doubled, doubled)):
        found = match_features(a, b, ratio=1.0)
        assert len(found) > 100
        assert len(np.unique(found[:, 0])) == len(np.unique(found[:, 1])) == len(found)


@pytest.mark.parametrize("metric", ["l2", "hamming"])
def test_mutual_matching_without_ratio_does_not_depend_on_the_order_of_pictures(
    metric: Literal["l2", "hamming"],
) -> None:
    first, second = draw(metric, 5)
    there = {(a, b) for a, b in match_features(first, second, ratio=1.0).tolist()}
    back = {(a, b) for b, a in match_features(second, first, ratio=1.0).tolist()}
    # Equal distances alone may be settled otherwise.
    assert len(there ^ back) <= (0 if metric == "l2" else 30)


@pytest.mark.parametrize("metric", ["l2", "hamming"])
@pytest.mark.parametrize("counts", [(0, 5), (5, 0), (5, 1)])
def test_too_few_key_points_match_nothing(metric: Literal["l2", "hamming"], counts: tuple[int, int]) -> None:
    first, second = draw(metric, 6)
    a, b = (features(f.descriptors[:n], metric) for f, n in zip((first, second), counts, strict=True))
    assert match_features(a, b).shape == (0, 2)


def test_refuses_what_cannot_be_compared() -> None:
    first, _ = draw("l2", 7)
    _, second = draw("hamming", 7)
    with pytest.raises(UsageError, match="different kinds"):
        match_features(first, second)
    with pytest.raises(UsageError, match="ratio"):
        match_features(first, first, ratio=0.0)


def test_exhaustive_pairs_are_all_pairs_in_order() -> None:
    assert exhaustive_pairs(["b", "a", "c"]).pairs == (("b", "a"), ("b", "c"), ("a", "c"))
    assert exhaustive_pairs(["a"]).pairs == ()


def test_sequential_pairs_stay_in_the_window() -> None:
    names = [f"{n}" for n in range(6)]
    pairs = sequential_pairs(names, window=2)
    pairs.check()
    assert set(pairs.pairs) == {(a, b) for a in names for b in names if 0 < int(b) - int(a) <= 2}


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7])
@pytest.mark.parametrize("window", [1, 3, 10])
def test_a_loop_closes_and_lists_no_pair_twice(count: int, window: int) -> None:
    names = [f"{n}" for n in range(count)]
    pairs = sequential_pairs(names, window=window, loop=True)
    pairs.check()
    near = {tuple(sorted((a, (a + d) % count))) for a in range(count) for d in range(1, window + 1)}
    assert set(pairs.pairs) == {(names[a], names[b]) for a, b in near if a != b}


def test_a_window_needs_a_width() -> None:
    with pytest.raises(UsageError, match="window"):
        sequential_pairs(["a", "b"], window=0)
