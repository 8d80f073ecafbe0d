"""Fusion of range maps into one cloud."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.fusion.fuse import fuse_stream, join_clouds
from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.fusion.view import FusionView
from pano_mvs.algorithms.structure.mirrors import with_mirrors
from pano_mvs.api import (
    All,
    Context,
    One,
    Panorama,
    Params,
    PointCloud,
    Pose,
    RangeMap,
    settings_from,
    stage,
)
from pano_mvs.io.growing_arrays import GrowingArrays
from pano_mvs.scene.surfaces import Structure


@stage("fusion.vote", settings=FusionSettings)
def vote(
    ranges: All[RangeMap],
    poses: All[Pose],
    images: All[Panorama],
    params: Params,
    ctx: Context,
    planes: One[Structure] | None = None,
) -> PointCloud:
    """Fuse range maps into one coloured cloud with normals, keeping points on which several views agree.

    Groups of poses are fused one by one, because their relative positions are unknown. What views see in the mirrors of
    depth.scene_planes is left out.
    """
    settings = settings_from(FusionSettings, params)
    groups = {name: pose.group for name, pose in poses.items()}
    clouds = []
    for number in range(max(groups.values(), default=0) + 1):
        names = [name for name in ranges if groups.get(name) == number and name in images]
        join = partial(_joined_in_files, folder=ctx.scratch / f"group_{number}")
        fused = _fused(
            names, ranges, poses, images=images, planes=planes, settings=settings, join=join, threads=ctx.threads
        )
        clouds.append(fused)
        if not len(clouds[-1]):
            which = f"group {number}: " if len(set(groups.values())) > 1 else ""
            why = (
                f"at no pixel did {_min_views(settings, len(names))} views agree. Look at the poses, or lower "
                "min_confidence or min_views"
                if any(ranges[name].valid.any() for name in names)
                else "no view has any range. Check the masks and the messages of the depth stage"
            )
            ctx.note(f"{which}the cloud is empty: {why}")
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
    planes: Structure | None,
    settings: FusionSettings,
    join: Callable[[Iterable[PointCloud]], PointCloud],
    threads: int,
) -> PointCloud:
    """Return the cloud of the views of one group."""
    settings = replace(settings, min_views=_min_views(settings, len(names)))

    def load(idx: int) -> FusionView:
        name, image, pose = names[idx], images[names[idx]], poses[names[idx]]
        seen = ranges[name]
        if planes is not None:
            seen = with_mirrors(seen, planes, pose.cam_from_world, group=pose.group)
        return FusionView(seen, pose.cam_from_world, image.load(), image.load_mask())

    cams = [poses[name].cam_from_world for name in names]
    return fuse_stream(cams, load, settings, join=join, threads=threads)


_ARRAYS = tuple(field.name for field in fields(PointCloud) if field.name != "group_sizes")


def _joined_in_files(clouds: Iterable[PointCloud], *, folder: Path) -> PointCloud:
    """Return one cloud of the points of several, as `join_clouds` does, whose arrays are memory-mapped files."""
    points = 0
    with GrowingArrays(folder) as grown:
        for cloud in clouds:
            points += len(cloud)
            grown.append({name: getattr(cloud, name) for name in _ARRAYS})
        whole: dict[str, Any] = {name: array for name, array in grown.arrays().items() if len(array) == points}
    return PointCloud(**whole) if whole else join_clouds([])


def _min_views(settings: FusionSettings, views: int) -> int:
    """Return the number of views that must agree on a point, at most the number of views."""
    return min(settings.min_views, max(1, views))
