"""Which pairs of images learned matches may connect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pano_mvs.algorithms.matching.pair_selection import retrieval_pairs
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Pairs, TwoView


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
