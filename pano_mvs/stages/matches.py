"""Matchers: find matching key points of two images, and verify them by the images' two-view geometry."""

from __future__ import annotations

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.preemptive import hopeless_reason
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.api import Context, Features, Near, Params, TwoView, arguments_from, params_from, stage


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
