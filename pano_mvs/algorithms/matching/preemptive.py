"""Preemptive matching: reject pairs by a few key points before all descriptors are matched."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.core.text import plural
from pano_mvs.scene import Features

_RATIO = 0.8
_MIN_SHARE, _MIN_MATCHES = 0.02, 4


@checks_settings
def hopeless_reason(
    first: Features,
    second: Features,
    *,
    preemptive: Annotated[
        int,
        Setting("skip a pair if hardly any of this many strongest key points match (for example 400); 0: never", ge=0),
    ] = 0,
) -> str:
    """Return why a pair is not worth matching, by its strongest key points alone; "" if it may be.

    Wu, "Towards Linear-time Incremental Structure from Motion", 2013, section 3: most pairs of a large set have no
    overlap, which a few hundred key points are enough to detect.

    Args:
        first: key points of the first image, strongest first.
        second: key points of the second image.
        preemptive: number of key points to match; 0 accepts every pair.
    """
    if not preemptive or min(len(first), len(second)) <= preemptive:
        return ""
    found = len(match_features(_strongest(first, preemptive), _strongest(second, preemptive), ratio=_RATIO))
    needed = max(_MIN_MATCHES, int(_MIN_SHARE * preemptive))
    if found >= needed:
        return ""
    verb = plural(found, "matches", "match")
    return f"only {found} of their {preemptive} strongest key points {verb}, {needed} needed for a closer look"


def _strongest(features: Features, count: int) -> Features:
    return replace(
        features,
        bearings=features.bearings[:count],
        descriptors=features.descriptors[:count],
        sizes_rad=features.sizes_rad[:count],
        scores=features.scores[:count],
        colors_rgb=features.colors_rgb[:count],
    )
