"""Matchers: find matching key points of two images, and verify them by the geometry of pairs and of groups."""

from __future__ import annotations

from collections.abc import Mapping, Sized
from typing import Any

from pydantic import Field

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.preemptive import hopeless_reason
from pano_mvs.algorithms.poses.joining.bridges import Bridges, find_bridges
from pano_mvs.algorithms.poses.joining.pair_matcher import KEPT_IMAGES
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.api import (
    All,
    Context,
    Features,
    Near,
    Panorama,
    Params,
    TwoView,
    TwoViews,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.stages.frame import one_panorama_bytes
from pano_mvs.stages.poses import panorama_loader


@params_from(match_features, hopeless_reason, verify_pair)
class BruteForceParams(Params):
    """Settings of matches.brute_force."""


@stage("matches.brute_force")
def brute_force(features: Near[Features], params: BruteForceParams, ctx: Context) -> TwoView:
    """Match all descriptors (ratio and mutual test), then verify the matches by spherical RANSAC."""
    first, second = features
    if reason := hopeless_reason(first, second, **arguments_from(hopeless_reason, params)):
        return TwoView.failed(reason)
    candidates = match_features(first, second, **arguments_from(match_features, params))
    two_view = verify_pair(
        first,
        second,
        candidates,
        rng=ctx.rng,
        **arguments_from(verify_pair, params),
    )
    ctx.metric("candidates", len(candidates))
    ctx.metric("inliers", len(two_view) if two_view else 0)
    if two_view:
        ctx.metric("alternatives", len(two_view.alternatives))
        ctx.metric("residual_deg", two_view.residual_deg)
        ctx.metric("direction_std_deg", two_view.direction_std_deg)
        ctx.metric("parallax_deg", two_view.parallax_deg)
    return two_view


@params_from(find_bridges, own_last=True)
class BridgesParams(Params):
    """Settings of matches.bridges."""

    squeezed_tiles: bool = Field(
        default=True, description="describe SIFT key points also as they look in tiles that are squeezed horizontally"
    )


_BYTES_PER_IMAGE, _BYTES_PER_PAIR, _BYTES_OF_A_MATCH = 16 << 20, 128 << 10, 512 << 20
_BYTES_OF_LAYERS = 12 << 20  # of an image with 12,000 key points, each described in all tiles


def _bridges_memory(params: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory for all key points and pairs, the comparison of two images, and squeezed tiles."""
    assert isinstance(params, BridgesParams)
    images, pairs = inputs["features"], inputs["matches"]
    assert isinstance(images, Sized)
    assert isinstance(pairs, Sized)
    needed = _BYTES_OF_A_MATCH + _BYTES_PER_IMAGE * len(images) + _BYTES_PER_PAIR * len(pairs)
    if params.squeezed_tiles:
        needed += _BYTES_OF_LAYERS * min(len(images), KEPT_IMAGES) + one_panorama_bytes(params, inputs)
    return needed


@stage("matches.bridges", memory=_bridges_memory)
def bridges(
    features: All[Features], matches: All[TwoView], images: All[Panorama], params: BridgesParams, ctx: Context
) -> TwoViews:
    """Add pairs between groups of images that hardly see each other, such as rooms joined by doors.

    The groups that no reliable pair connects are aligned with all matches between their images together. A door shows
    the next room obliquely, so that the SIFT key points of these images are also described in tiles that are squeezed
    horizontally. The result has all pairs, old and new. If the pairs connect all images, nothing is matched, no image
    is read, and the pairs stay as they are.
    """
    found = find_bridges(
        features,
        matches,
        **arguments_from(find_bridges, params),
        rng=ctx.rng,
        load=panorama_loader(images) if params.squeezed_tiles else None,
    )
    _report(found, ctx)
    return TwoViews({**matches, **found.two_views})


def _report(found: Bridges, ctx: Context) -> None:
    before, after = found.groups
    ctx.metric("groups_before", before)
    ctx.metric("groups_after", after)
    ctx.metric("new_pairs", len(found.two_views))
    for bridge in found.bridges:
        first, second = (f"{names[0]} …" if len(names) > 1 else names[0] for names in bridge.images)
        ctx.note(f"the group of {first} was joined with the group of {second}: {bridge.inliers} matches agree")
