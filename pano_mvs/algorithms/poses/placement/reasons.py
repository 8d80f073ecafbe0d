"""Why an image is left out, in a photographer's words."""

from __future__ import annotations

from collections.abc import Mapping

from pano_mvs.scene import TwoView


def best_pair(name: str, two_views: Mapping[tuple[str, str], TwoView]) -> tuple[str, str] | None:
    """Return the pair of an image that says most: sound before unsound, then with most matches; None without any."""
    tried = [(bool(view), len(view), view.candidates, pair) for pair, view in two_views.items() if name in pair]
    return max(tried)[-1] if tried else None


def why_no_pair(name: str, two_views: Mapping[tuple[str, str], TwoView]) -> str:
    """Return why an image has no sound pair with any other; empty if it has one."""
    pair = best_pair(name, two_views)
    if pair is None:
        return "it was compared with no other picture"
    if two_views[pair]:
        return ""
    partner = pair[1] if pair[0] == name else pair[0]
    return f"no sound pair; the best partner is {partner!r}: {two_views[pair].reason}"
