"""Match the images of small groups with further images, after the pairs that a selector chose have been matched."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.placement.view_graph import Edge, connected_groups
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.scene import Features, TwoView

_SMALL = 6  # images of a group that gets further candidates


def further_pairs(
    features: Mapping[str, Features],
    two_views: Mapping[tuple[str, str], TwoView],
    similarities: NDArray[np.float64],
    *,
    candidates: int,
    rng: np.random.Generator,
) -> dict[tuple[str, str], TwoView]:
    """Return the verified pairs of images of small groups with similar images of other groups.

    A selector such as `pairs.retrieval` chooses the same number of images for each one. An image in a group of a few
    images, which no reliable pair connects with the others, is compared with more of them.

    Args:
        features: key points by image name, in the capture's order.
        two_views: the pairs that were matched before; none of them is matched again.
        similarities: (N, N) of the images.
        candidates: number of further images for each image of a small group, the most similar ones outside.
        rng: draws the samples.
    """
    names = tuple(features)
    number = {name: idx for idx, name in enumerate(names)}
    compared = {frozenset((number[a], number[b])) for a, b in two_views}
    groups = connected_groups(((number[a], number[b]) for (a, b), view in two_views.items() if view), len(names))
    found: dict[tuple[str, str], TwoView] = {}
    for a, b in _candidates(groups, compared, similarities, candidates=candidates):
        first, second = features[names[a]], features[names[b]]
        view = verify_pair(first, second, match_features(first, second), rng=rng)
        if view:
            found[names[a], names[b]] = view
    return found


def _candidates(
    groups: list[list[int]], compared: set[frozenset[int]], similarities: NDArray[np.float64], *, candidates: int
) -> list[Edge]:
    """Return pairs of images (first < second) that were not compared, sorted."""
    chosen: set[Edge] = set()
    for group in groups:
        if len(group) > _SMALL or len(groups) == 1:
            continue
        for image in group:
            others = [
                other
                for other in range(len(similarities))
                if other not in group and frozenset((image, other)) not in compared
            ]
            best = sorted(others, key=lambda other: (-similarities[image, other], other))[:candidates]
            chosen |= {(min(image, other), max(image, other)) for other in best}
    return sorted(chosen)
