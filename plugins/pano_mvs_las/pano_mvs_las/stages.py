"""The stages export.las and export.e57."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from pano_mvs.api import (
    All,
    Context,
    Files,
    InputError,
    KeptPoints,
    One,
    Panorama,
    Params,
    PointCloud,
    PointSelection,
    Poses,
    UsageError,
    group_file,
    params_from,
    select_points,
    settings_from,
    split_groups,
    stage,
)
from pydantic import Field

from pano_mvs_las.e57_file import PlacedPanorama, write_e57
from pano_mvs_las.las_file import write_las
from pano_mvs_las.placement import Placement, placement_of


@params_from(PointSelection)
class CloudParams(Params):
    """Settings of both exports."""

    epsg: int | None = Field(
        default=None, ge=0, description="map to place the cloud on, if GPS placed the cameras; null: UTM; 0: none"
    )


class LasParams(CloudParams):
    """Settings of export.las."""

    format: Literal["las", "laz"] = Field(default="laz", description="plain, or compressed without loss")
    step: float = Field(default=0.0001, gt=0, description="of the coordinates, which are whole numbers of it")


@stage("export.las")
def las(cloud: One[PointCloud], poses: One[Poses], params: LasParams, ctx: Context) -> Files:
    """The fused cloud as cloud.laz (or .las): LAS 1.4 with 16-bit colours, z up; normals, views and confidence too.

    Further groups of poses, each in a frame of its own, are cloud_1.laz …
    """
    files = {}
    for number, group, kept, placement in _prepared(cloud, poses, params, ctx):
        path = ctx.scratch / group_file(f"cloud.{params.format}", number)
        write_las(path, group, placement, step=params.step, kept=kept)
        files[path.name] = path
    return Files(files)


class E57Params(CloudParams):
    """Settings of export.e57."""

    panoramas: bool = Field(default=True, description="also write the panoramas, as spherical images with their poses")


@stage("export.e57")
def e57(
    cloud: One[PointCloud], poses: One[Poses], images: All[Panorama] | None, params: E57Params, ctx: Context
) -> Files:
    """The fused cloud as cloud.e57: one scan with colours and normals, z up, and the panoramas with their poses.

    Panoramas are JPEG at working resolution, with a mask where they are masked. Further groups of poses, each in a
    frame of its own, are cloud_1.e57 …
    """
    files = {}
    groups = split_groups(poses)
    for number, group, kept, placement in _prepared(cloud, poses, params, ctx):
        path = ctx.scratch / group_file("cloud.e57", number)
        own = groups[number]
        panoramas = (
            PlacedPanorama(name, images[name], own.cam_from_world(idx))
            for idx, name in enumerate(own.names)
            if images is not None and params.panoramas and name in images
        )
        write_e57(path, group, placement, kept=kept, panoramas=panoramas)
        files[path.name] = path
    return Files(files)


def _prepared(
    cloud: PointCloud, poses: Poses, params: CloudParams, ctx: Context
) -> Iterator[tuple[int, PointCloud, KeptPoints | None, Placement]]:
    """Yield the number and the cloud of each group that has points, which of them are written, and where."""
    selection = settings_from(PointSelection, params)
    total = 0
    for number, (group, own) in enumerate(zip(cloud.groups(), split_groups(poses), strict=False)):
        kept = select_points(group, selection, ctx.scratch)
        count = len(group) if kept is None else kept.count
        if not count:
            if not number:
                raise InputError("the cloud has no points that could be written")
            continue
        placement = _placement(own, params.epsg, number, ctx)
        total += count
        yield number, group, kept, placement
    ctx.metric("points", total)


def _placement(poses: Poses, epsg: int | None, number: int, ctx: Context) -> Placement:
    """Return where the points of a group are written; where GPS placed the largest group alone, the others on no map.

    Raises:
        UsageError: of the largest group.
    """
    try:
        placement = placement_of(poses, epsg)
    except UsageError as error:
        if not number:
            raise
        ctx.note(f"group {number} is on no map: {error}")
        return placement_of(poses, 0)
    if placement.crs is not None:
        which = f"the cloud of group {number}" if number else "the cloud"
        ctx.note(f"{which} is on the map {placement.crs.name} (EPSG:{placement.crs.to_epsg()})")
    return placement
