"""Which images SIFT leaves without enough matches, and which pairs of images learned matches may connect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from pano_mvs.algorithms.matching.pair_selection import retrieval_pairs, similarities
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Pairs, TwoView, WeakImages


@checks_settings
def weak_images(
    features: Mapping[str, Features],
    matches: Mapping[tuple[str, str], TwoView],
    *,
    learned: Annotated[
        Literal["auto", "always", "never"],
        Setting("which images get learned key points: the weakly matched ones, all or none"),
    ] = "auto",
    min_share: Annotated[
        float, Setting("a pair with fewer verified matches, as a share of its key points, connects weakly", ge=0, le=1)
    ] = 0.015,
    partners: Annotated[int, Setting("number of similar images that a weak one may match", ge=1)] = 10,
) -> WeakImages:
    """Find the images that pairs with many verified matches do not connect with most of the capture.

    Args:
        features: key points of all images, in the capture's order.
        matches: the verified pairs.
        min_share: number of matches by which a pair connects its images well, as a share of the key points of the image
            that has fewer. In dense captures, the least share that connects all images is .02 to .15, in tours .005 to
            .012.
    """
    names = list(features)
    if learned != "auto":
        return WeakImages(weak=tuple(names)) if learned == "always" else WeakImages(others=tuple(names))
    number = {name: idx for idx, name in enumerate(names)}
    counts = np.array([len(one) for one in features.values()])
    strong = np.zeros((len(names), len(names)), np.int8)
    for (first, second), view in matches.items():
        pair = number[first], number[second]
        strong[pair] = int(bool(view) and len(view) >= min_share * counts[list(pair)].min())
    group_of = connected_components(csr_array(strong), directed=False)[1]
    sizes = np.bincount(group_of)
    weak = np.flatnonzero((group_of != np.argmax(sizes)) | (sizes[group_of] == 1)).tolist()
    if not weak:
        return WeakImages(others=tuple(names))
    alike = similarities(features.values())
    np.fill_diagonal(alike, -np.inf)
    similar = {int(idx) for one in weak for idx in np.argsort(-alike[one], kind="stable")[:partners]} - {*weak}
    rest = set(range(len(names))) - {*weak} - similar
    groups = (sorted(group) for group in (weak, similar, rest))
    return WeakImages(*(tuple(names[idx] for idx in group) for group in groups))


@checks_settings
def learned_pairs(
    features: Mapping[str, Features],
    matches: Mapping[tuple[str, str], TwoView] | None = None,
    *,
    neighbours: Annotated[int, Setting("number of most similar images to match each one with", ge=1)] = 8,
) -> Pairs:
    """Pair each image that has learned key points with those whose learned descriptors are most similar.

    Verified pairs of such images are among them, so that a network looks at every pair that the poses rely on.

    Args:
        features: key points of all images, in the capture's order.
        matches: pairs that were compared without a network.
    """
    descriptors = {
        name: vlad_descriptor(one.only_learned(), sample=1000) for name, one in features.items() if one.learned
    }
    found = retrieval_pairs(list(descriptors), descriptors, neighbours=neighbours)
    verified = {pair for pair, view in (matches or {}).items() if descriptors.keys() >= {*pair} and view}
    place = {name: idx for idx, name in enumerate(features)}
    return Pairs(tuple(sorted({*found.pairs, *verified}, key=lambda pair: (place[pair[0]], place[pair[1]]))))
