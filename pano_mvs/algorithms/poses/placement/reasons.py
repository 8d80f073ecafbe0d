"""Reasons for leaving out an image, in words for photographers."""

from __future__ import annotations

from collections.abc import Mapping

from pano_mvs.algorithms.poses.placement.resection import MIN_POINTS, points_needed
from pano_mvs.core.text import plural
from pano_mvs.scene import TwoView


def best_pair(name: str, two_views: Mapping[tuple[str, str], TwoView]) -> tuple[str, str] | None:
    """Return the best pair of an image, reliable pairs first, then by number of matches; None if it has no pair."""
    tried = [(bool(view), len(view), view.candidates, pair) for pair, view in two_views.items() if name in pair]
    return max(tried)[-1] if tried else None


def why_no_pair(name: str, two_views: Mapping[tuple[str, str], TwoView]) -> str:
    """Return why an image has no reliable pair with any other image; "" if it has one."""
    pair = best_pair(name, two_views)
    if pair is None:
        return "it was not compared with any other image"
    if two_views[pair]:
        return ""
    partner = pair[1] if pair[0] == name else pair[0]
    return f"it has no reliable pair; its best partner is {partner!r}: {two_views[pair].reason}"


def why_few_seen(support: int, known: int, *, agreeing: int = 1) -> str:
    """Return why a camera is not reliable that sees too few known points where they should be."""
    return (
        f"only {support} of {known} points known from other images {plural(support, 'is', 'are')} seen where they "
        f"should be; {points_needed(known, agreeing=agreeing)} are needed. Possible causes: repeated structure, moving "
        "objects, stitching errors, or an image that is not a panorama"
    )


def why_few_known(known: int, *, partner: str, matches: int) -> str:
    """Return why an image cannot be placed that matches too few known points; its best pair is with `partner`."""
    return (
        f"only {known} of its points {plural(known, 'is', 'are')} known from two other images; {MIN_POINTS} are "
        f"needed. Its best partner is {partner!r} with {matches} {plural(matches, 'match', 'matches')}. "
        "Take panoramas in between"
    )
