"""Matchers: find matching key points of two images, and verify them by the geometry of the pair."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.learned.lightglue import few_and_all_matches, match_learned
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.two_view.learned_pairs import is_settled
from pano_mvs.algorithms.two_view.linked_pairs import judged_by_links
from pano_mvs.algorithms.two_view.verification import pair_marks, verify_pair
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
from pano_mvs.core.text import plural, shortened_list
from pano_mvs.stages.features import NetworkParams


@stage("matches.brute_force", settings=(match_features, verify_pair))
def brute_force(features: Near[Features], params: Params, ctx: Context) -> TwoView:
    """Match all descriptors (ratio and mutual test), then verify the matches by spherical RANSAC."""
    first, second = features
    candidates = match_features(first, second, **arguments_from(match_features, params))
    two_view = verify_pair(
        first,
        second,
        candidates,
        rng=ctx.rng,
        **arguments_from(verify_pair, params),
    )
    _report_pair(two_view, len(candidates), ctx)
    return two_view


@params_from(match_learned, verify_pair, own_last=True)
class LightGlueParams(NetworkParams):
    """Settings of matches.lightglue."""


@stage("matches.lightglue", memory="900MB")
def lightglue(features: Near[Features], params: LightGlueParams, ctx: Context) -> TwoView:
    """Match the key points of features.aliked by the network LightGlue, then verify the matches by spherical RANSAC.

    The network compares the key points of level views of both panoramas, in pairs of views with similar descriptors:
    the strongest ones of the first three pairs, then, unless these settle whether the images show the same, all of
    them. Key points of an earlier stage of features are matched as in matches.brute_force, and verified together with
    these.
    """
    first, second = features
    found = match_features(first.without_learned(), second.without_learned())
    settings = arguments_from(match_learned, params)
    for learned in few_and_all_matches(first, second, networks=params.networks, **settings):
        candidates = np.concatenate([found, learned])
        two_view = verify_pair(first, second, candidates, rng=ctx.rng, **arguments_from(verify_pair, params))
        if is_settled(two_view, pair_marks(first, second, two_view) if two_view else None):
            break
    _report_pair(two_view, len(candidates), ctx)
    return two_view


@stage("matches.merge", memory="600MB")
def merge(
    matches: All[TwoView],
    added: All[TwoView] | None,
    features: All[Features] | None,
    images: All[Panorama] | None,
    ctx: Context,
) -> TwoViews:
    """Return the pairs of two stages; of a pair in both, the added geometry, even if it is not verified.

    Of scenes of a virtual tour that lead to each other, the directions of the links count beside the learned matches.
    """
    merged = {**matches, **(added or {})}
    links = {name: image.links for name, image in (images or {}).items() if image.links}
    if not links or features is None:
        return TwoViews(merged)
    judged = judged_by_links(merged, features, links)
    found = [pair for pair, view in judged.items() if view and not merged[pair]]
    lost = [pair for pair, view in judged.items() if merged[pair] and not view]
    ctx.metric("by_links", len(found))
    if found:
        ctx.note(f"links of the tour confirm the matches of {_named(found)}")
    if lost:
        ctx.note(f"links of the tour contradict the matches of {_named(lost)}")
    return TwoViews(judged)


def _named(pairs: list[tuple[str, str]]) -> str:
    names = shortened_list([f"{first} and {second}" for first, second in pairs])
    return f"{len(pairs)} {plural(len(pairs), 'pair')}: {names}"


def _report_pair(two_view: TwoView, candidates: int, ctx: Context) -> None:
    ctx.metric("candidates", candidates)
    ctx.metric("inliers", len(two_view) if two_view else 0)
    if two_view:
        ctx.metric("alternatives", len(two_view.alternatives))
        ctx.metric("residual_deg", two_view.residual_deg)
        ctx.metric("direction_std_deg", two_view.direction_std_deg)
        ctx.metric("parallax_deg", two_view.parallax_deg)
