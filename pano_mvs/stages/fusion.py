"""Fusion of range maps into one cloud."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field

from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.fusion.view import FusionView
from pano_mvs.algorithms.fusion.vote import fuse_stream
from pano_mvs.api import All, Context, Panorama, Params, PointCloud, Pose, RangeMap, stage


class FusionParams(Params):
    """Settings of `fusion.vote`."""

    min_views: int = Field(default=2, ge=1, description="minimum number of views that agree on a point")
    max_relative_error: float = Field(
        default=0.02, gt=0, description="maximum relative difference of ranges that agree"
    )
    min_support: float | None = Field(
        default=0.1,
        gt=0,
        le=1,
        description="confirmed share of the surface around a pixel that replaces one missing view",
    )
    merge_within: float = Field(
        default=0.01, ge=0, description="average points of views with a smaller relative difference"
    )
    max_footprint_ratio: float = Field(
        default=4.0,
        ge=1,
        description="leave a point to another view that sees it this much better; 1: no duplicate points",
    )
    even_density: bool = Field(
        default=True, description="thin rows away from the equator to even density per solid angle"
    )
    stride: int = Field(default=1, ge=1, description="use every stride-th pixel in both directions")
    min_confidence: int = Field(
        default=64, ge=1, le=255, description="minimum confidence of pixels (64: seen, 128: consistent)"
    )
    neighbours: int = Field(default=8, ge=0, description="number of nearest views to compare each view with")
    voxel_size: float | None = Field(
        default=None, gt=0, description="thin to one point per voxel of this edge, scene units"
    )


@stage("fusion.vote")
def vote(
    ranges: All[RangeMap], poses: All[Pose], images: All[Panorama], params: FusionParams, ctx: Context
) -> PointCloud:
    """Fuse range maps into one coloured cloud with normals, keeping points on which several views agree.

    Groups of poses are fused one by one, because their relative positions are unknown.
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
    params: FusionParams,
    threads: int,
) -> PointCloud:
    """Return the cloud of the views of one group."""
    settings = params.model_dump() | {"min_views": _min_views(params, len(names))}

    def load(idx: int) -> FusionView:
        name, image = names[idx], images[names[idx]]
        return FusionView(ranges[name], poses[name].cam_from_world, image.load(), image.load_mask())

    cams = [poses[name].cam_from_world for name in names]
    return fuse_stream(cams, load, FusionSettings(**settings), threads=threads)


def _min_views(params: FusionParams, views: int) -> int:
    """Return the number of views that must agree on a point, at most the number of views."""
    return min(params.min_views, max(1, views))


def _why_empty(ranges: Mapping[str, RangeMap], min_views: int) -> str:
    if not any(range_map.valid.any() for range_map in ranges.values()):
        return "the cloud is empty: no view has any range. Check the masks and the messages of the depth stage"
    return (
        f"the cloud is empty: at no pixel did {min_views} views agree. Look at the poses, or lower min_confidence or "
        "min_views"
    )
