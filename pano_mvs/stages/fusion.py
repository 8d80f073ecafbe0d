"""Fusion of range maps into one cloud."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.fusion.fuse import fuse_stream
from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.fusion.view import FusionView
from pano_mvs.api import (
    All,
    Context,
    One,
    Panorama,
    Params,
    PointCloud,
    Pose,
    RangeMap,
    params_from,
    settings_from,
    stage,
)


@params_from(FusionSettings)
class FusionParams(Params):
    """Settings of `fusion.vote`."""


@stage("fusion.vote")
def vote(
    ranges: All[RangeMap], poses: All[Pose], images: All[Panorama], params: FusionParams, ctx: Context
) -> PointCloud:
    """Fuse range maps into one coloured cloud with normals, keeping points on which several views agree.

    Groups of poses are fused one by one, because their relative positions are unknown.
    """
    settings = settings_from(FusionSettings, params)
    groups = {name: pose.group for name, pose in poses.items()}
    clouds = []
    for number in range(max(groups.values(), default=0) + 1):
        names = [name for name in ranges if groups.get(name) == number and name in images]
        clouds.append(_fused(names, ranges, poses, images=images, settings=settings, threads=ctx.threads))
        if not len(clouds[-1]):
            which = f"group {number}: " if len(set(groups.values())) > 1 else ""
            ctx.note(
                which
                + _why_empty(
                    {name: ranges[name] for name in names},
                    _min_views(settings, len(names)),
                )
            )
    cloud = PointCloud.of_groups(clouds)
    ctx.metric("points", len(cloud))
    return cloud


class ScaleCloudParams(Params):
    """Settings of fusion.scale."""

    factor: float = Field(default=1.0, gt=0, description="new units per unit of the cloud, such as metres")
    group: int = Field(default=0, ge=0, description="group of the poses whose points are scaled; 0 is the largest")


def cloud_memory_bytes(_: ScaleCloudParams, inputs: Mapping[str, Any]) -> int:
    """Return the memory for a copy of the cloud."""
    return 100_000_000 + 100 * len(inputs["cloud"])


@stage("fusion.scale", memory=cloud_memory_bytes)
def scale_cloud(cloud: One[PointCloud], params: ScaleCloudParams, ctx: Context) -> PointCloud:
    """Multiply all positions by a factor, for results whose scale is known only afterwards; see `pano-mvs scale`."""
    clouds = cloud.groups()
    if params.group < len(clouds):
        chosen, factor = clouds[params.group], np.float32(params.factor)
        uncertainty = None if chosen.uncertainty is None else chosen.uncertainty * factor
        clouds[params.group] = replace(chosen, points_in_world=chosen.points_in_world * factor, uncertainty=uncertainty)
    ctx.metric("points", len(cloud))
    return PointCloud.of_groups(clouds)


def _fused(
    names: list[str],
    ranges: All[RangeMap],
    poses: All[Pose],
    *,
    images: All[Panorama],
    settings: FusionSettings,
    threads: int,
) -> PointCloud:
    """Return the cloud of the views of one group."""
    settings = replace(settings, min_views=_min_views(settings, len(names)))

    def load(idx: int) -> FusionView:
        name, image = names[idx], images[names[idx]]
        return FusionView(ranges[name], poses[name].cam_from_world, image.load(), image.load_mask())

    cams = [poses[name].cam_from_world for name in names]
    return fuse_stream(cams, load, settings, threads=threads)


def _min_views(settings: FusionSettings, views: int) -> int:
    """Return the number of views that must agree on a point, at most the number of views."""
    return min(settings.min_views, max(1, views))


def _why_empty(ranges: Mapping[str, RangeMap], min_views: int) -> str:
    if not any(range_map.valid.any() for range_map in ranges.values()):
        return "the cloud is empty: no view has any range. Check the masks and the messages of the depth stage"
    return (
        f"the cloud is empty: at no pixel did {min_views} views agree. Look at the poses, or lower min_confidence or "
        "min_views"
    )
