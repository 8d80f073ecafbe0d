"""Matches by several descriptors equal a plain search over key points."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.descriptor_layers import DescriptorLayer, match_layers
from pano_mvs.scene import Features
from tests.algorithms.features.test_matching import draw

RNG_SEED = 5


def _layer(features: Features, rng: np.random.Generator, other: Features | None = None) -> DescriptorLayer:
    """Return noisy descriptors of a third of the key points, some like those of another image's key points."""
    chosen = np.sort(rng.choice(len(features), len(features) // 3, replace=False))
    source = features if other is None else other
    picked = source.descriptors[chosen if other is None else rng.integers(0, len(source), len(chosen))]
    return DescriptorLayer(chosen, (picked + rng.integers(-9, 10, picked.shape)).astype(np.int16))


def _plain_search(
    first: Features, second: Features, first_layers: list[DescriptorLayer], second_layers: list[DescriptorLayer]
) -> tuple[NDArray[np.float64], dict[int, tuple[int, float, float]]]:
    """Return the distances of all pairs of key points, and for each of the first image its nearest two."""
    distance = np.full((len(first), len(second)), np.inf)

    def compare(one: DescriptorLayer, other: DescriptorLayer) -> None:
        a, b = one.descriptors.astype(np.float64), other.descriptors.astype(np.float64)
        found = ((a[:, None] - b[None]) ** 2).sum(axis=-1)
        here = np.ix_(one.keypoint_idx, other.keypoint_idx)
        distance[here] = np.minimum(distance[here], found)

    own = [DescriptorLayer(np.arange(len(one)), one.descriptors) for one in (first, second)]
    compare(*own)
    for layer in second_layers:
        compare(own[0], layer)
    for layer in first_layers:
        compare(layer, own[1])
    nearest = {}
    for idx, row in enumerate(distance):
        best = int(row.argmin())
        nearest[idx] = best, float(row[best]), float(np.delete(row, best).min())
    return distance, nearest


@pytest.mark.parametrize("ratio", [0.6, 0.8, 0.95])
def test_equals_the_plain_search_over_key_points(ratio: float) -> None:
    rng = np.random.default_rng(RNG_SEED)
    first, second = draw("l2", 3, count=240)
    layers = [_layer(first, rng), _layer(first, rng, second)], [_layer(second, rng), _layer(second, rng, first)]
    found = match_layers(first, second, first_layers=layers[0], second_layers=layers[1]).below(ratio)
    distance, nearest = _plain_search(first, second, *layers)
    by_second: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for idx, (best, squared, next_squared) in nearest.items():
        if squared <= distance[:, best].min() and squared < np.float32(ratio**2) * np.float32(next_squared):
            by_second[best].append((squared, idx))
    expected = sorted((min(rivals)[1], best) for best, rivals in by_second.items())
    assert [tuple(match) for match in found.tolist()] == expected
    plain = {tuple(match) for match in match_features(first, second, ratio=ratio).tolist()}
    assert len(set(expected) - plain) > 5


@pytest.mark.parametrize("ratio", [0.6, 0.8, 0.95])
def test_without_layers_the_matches_are_those_of_the_key_points(ratio: float) -> None:
    first, second = draw("l2", 4)
    found = match_layers(first, second).below(ratio)
    np.testing.assert_array_equal(found, match_features(first, second, ratio=ratio))


def test_images_without_key_points_have_no_matches() -> None:
    first, second = draw("l2", 4, count=8)
    none = draw("l2", 4, count=0)[0]
    for a, b in ((first, none), (none, second), (none, none)):
        assert len(match_layers(a, b).matches_idx) == 0
