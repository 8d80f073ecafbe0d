"""Matchers: which key points of two pictures are the same, and what the pictures' geometry says of it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.preemptive import hopeless_reason
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.api import Context, Features, Near, Params, TwoView, stage


class BruteForceParams(Params):
    """Settings of matches.brute_force."""

    ratio: float = Field(default=0.8, gt=0, le=1, description="best distance over second best, at most")
    mutual: bool = Field(default=True, description="only pairs that are each other's best")
    preemptive: int = Field(
        default=0,
        ge=0,
        description="leave a pair out if so many strongest key points hardly match (400, say); 0: never",
    )
    threshold_deg: float = Field(default=0.2, gt=0, le=10, description="angular Sampson error of a match that agrees")
    min_inliers: int = Field(default=20, ge=8, description="agreeing matches that a pair needs")
    solver: Literal["five_point", "eight_point"] = Field(
        default="five_point", description="how hypotheses are made; eight_point is the paper's, and weak on one plane"
    )
    refine: bool = Field(default=True, description="false keeps the best hypothesis as it comes, as the paper does")
    max_alternatives: int = Field(
        default=4,
        ge=0,
        description="runner-up geometries that a pair keeps, for places with repeated structure; none without refine",
    )


@stage("matches.brute_force")
def brute_force(features: Near[Features], params: BruteForceParams, ctx: Context) -> TwoView:
    """Match all descriptors (ratio and mutual test), then verify by spherical RANSAC."""
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
