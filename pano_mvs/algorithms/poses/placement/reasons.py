"""Reasons for leaving out an image, in words for photographers."""

from __future__ import annotations

from collections.abc import Mapping

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
