"""Matchers: find matching key points of two images, and verify them by the images' two-view geometry."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.preemptive import hopeless_reason
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.api import Context, Features, Near, Params, TwoView, stage


class BruteForceParams(Params):
    """Settings of matches.brute_force."""

    ratio: float = Field(default=0.8, gt=0, le=1, description="maximum ratio of best to second-best distance")
    mutual: bool = Field(default=True, description="keep only matches that are each other's best")
    preemptive: int = Field(
        default=0,
        ge=0,
        description="skip a pair if hardly any of this many strongest key points match (for example 400); 0: never",
    )
    threshold_deg: float = Field(default=0.2, gt=0, le=10, description="maximum angular Sampson error of an inlier")
    min_inliers: int = Field(default=20, ge=8, description="minimum number of inliers of a pair")
    solver: Literal["five_point", "eight_point"] = Field(
        default="five_point", description="minimal solver; eight_point is the paper's, and unreliable on planar scenes"
    )
    refine: bool = Field(default=True, description="false keeps the best minimal hypothesis unrefined, as in the paper")
    max_alternatives: int = Field(
        default=4,
        ge=0,
        description="maximum number of runner-up geometries of a pair, for repeated structure; requires refine",
    )


@stage("matches.brute_force")
def brute_force(features: Near[Features], params: BruteForceParams, ctx: Context) -> TwoView:
    """Match all descriptors (ratio and mutual test), then verify the matches by spherical RANSAC."""
    first, second = features
    if reason := hopeless_reason(first, second, preemptive=params.preemptive):
        return TwoView.failed(reason)
    candidates = match_features(first, second, ratio=params.ratio, mutual=params.mutual)
    two_view = verify_pair(
        first,
        second,
        candidates,
        rng=ctx.rng,
        threshold_deg=params.threshold_deg,
        min_inliers=params.min_inliers,
        solver=params.solver,
        refine=params.refine,
        max_alternatives=params.max_alternatives,
    )
    ctx.metric("candidates", len(candidates))
    ctx.metric("inliers", len(two_view) if two_view else 0)
    if two_view:
        ctx.metric("alternatives", len(two_view.alternatives))
        ctx.metric("residual_deg", two_view.residual_deg)
        ctx.metric("direction_std_deg", two_view.direction_std_deg)
        ctx.metric("parallax_deg", two_view.parallax_deg)
    return two_view
