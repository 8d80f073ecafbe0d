"""Fusion: from range maps to one cloud."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.fusion.vote import FusionView, fuse_views
from pano_mvs.api import All, Context, Panorama, Params, PointCloud, Pose, RangeMap, stage


class VoteParams(Params):
    """Settings of fusion.vote."""

    min_views: int = Field(default=2, ge=1, description="views that must agree on a point")
    max_relative_error: float = Field(default=0.02, gt=0, description="ranges that agree differ by at most this share")
    voxel_size: float | None = Field(default=None, gt=0, description="thin to one point per cube, in scene units")
    min_confidence: int = Field(
        default=64, ge=1, le=255, description="pixels below have no vote (64: seen, 128: consistent)"
    )


@stage("fusion.vote")
def vote(
    ranges: All[RangeMap], poses: All[Pose], images: All[Panorama], params: VoteParams, ctx: Context
) -> PointCloud:
    """One coloured cloud with normals of all points on which several views agree."""
    views = [
        FusionView(range_map, poses[name].cam_from_world, images[name].load())
        for name, range_map in ranges.items()
        if name in poses and name in images
    ]
    cloud = fuse_views(
        views,
        min_views=min(params.min_views, len(views)),
        max_relative_error=params.max_relative_error,
        voxel_size=params.voxel_size,
        min_confidence=params.min_confidence,
    )
    ctx.metric("points", len(cloud))
    return cloud
