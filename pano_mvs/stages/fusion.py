"""Fusion: from range maps to one cloud."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field

from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.fusion.view import FusionView
from pano_mvs.algorithms.fusion.vote import fuse_stream
from pano_mvs.api import All, Context, Panorama, Params, PointCloud, Pose, RangeMap, stage


class VoteParams(Params):
    """Settings of fusion.vote."""

    min_views: int = Field(default=2, ge=1, description="views that must agree on a point")
    max_relative_error: float = Field(default=0.02, gt=0, description="ranges that agree differ by at most this share")
    min_support: float | None = Field(
        default=0.1, gt=0, le=1, description="share of the surface around a pixel that vouches for one missing view"
    )
    merge_within: float = Field(default=0.01, ge=0, description="points of views that differ by less are averaged")
    max_footprint_ratio: float = Field(
        default=4.0, ge=1, description="a view leaves to another what that sees this much better; 1: no point twice"
    )
    even_density: bool = Field(default=True, description="thin rows away from the equator to points per solid angle")
    stride: int = Field(default=1, ge=1, description="write every stride-th pixel in both directions")
    min_confidence: int = Field(
        default=64, ge=1, le=255, description="pixels below have no vote (64: seen, 128: consistent)"
    )
    neighbours: int = Field(default=8, ge=0, description="views, the nearest ones, that vote on a view's pixels")
    voxel_size: float | None = Field(default=None, gt=0, description="thin to one point per cube, in scene units")


@stage("fusion.vote")
def vote(
    ranges: All[RangeMap], poses: All[Pose], images: All[Panorama], params: VoteParams, ctx: Context
) -> PointCloud:
    """One coloured cloud with normals of all points on which several views agree.

    Groups of poses are fused one by one, since nothing is known of where they are to each other.
    """
    groups = {name: pose.group for name, pose in poses.items()}
    clouds = []
    for number in range(max(groups.values(), default=0) + 1):
        names = [name for name in ranges if groups.get(name) == number and name in images]
        clouds.append(_fused(names, ranges, poses, images, params, ctx.threads))
        if not len(clouds[-1]):
            which = f"group {number}: " if len(set(groups.values())) > 1 else ""
            ctx.note(which + _why_empty({name: ranges[name] for name in names}, _min_views(params, len(names))))
    cloud = PointCloud.of_groups(clouds)
    ctx.metric("points", len(cloud))
    return cloud


def _fused(
    names: list[str],
    ranges: All[RangeMap],
    poses: All[Pose],
    images: All[Panorama],
    params: VoteParams,
    threads: int,
) -> PointCloud:
    """Return the cloud of the views of one group."""
    settings = params.model_dump() | {"min_views": _min_views(params, len(names))}

    def load(idx: int) -> FusionView:
        name, image = names[idx], images[names[idx]]
        return FusionView(ranges[name], poses[name].cam_from_world, image.load(), image.load_mask())

    cams = [poses[name].cam_from_world for name in names]
    return fuse_stream(cams, load, FusionSettings(**settings), threads=threads)


def _min_views(params: VoteParams, views: int) -> int:
    """Return how many views must agree on a point: no more than there are."""
    return min(params.min_views, max(1, views))


def _why_empty(ranges: Mapping[str, RangeMap], min_views: int) -> str:
    if not any(range_map.valid.any() for range_map in ranges.values()):
        return "the cloud is empty: no view has any range. Look at the masks, and at what the depth stage says"
    return (
        f"the cloud is empty: at no pixel did {min_views} views agree. Look at the poses, or lower min_confidence or "
        "min_views"
    )
