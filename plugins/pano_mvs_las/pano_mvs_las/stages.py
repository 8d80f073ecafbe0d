"""The stages export.las and export.e57."""

from __future__ import annotations

from typing import Literal

from pano_mvs.api import Context, Files, InputError, One, Params, PointCloud, Poses, stage
from pano_mvs.io.thinning import Kept, Selection, select_points
from pydantic import Field

from pano_mvs_las.e57_file import write_e57
from pano_mvs_las.las_file import write_las
from pano_mvs_las.placement import Placement, placement_of


class CloudParams(Params):
    """Settings of both exports."""

    epsg: int | None = Field(
        default=None, ge=0, description="map to place the cloud on, if GPS placed the cameras; null: UTM; 0: none"
    )
    min_confidence: int = Field(default=0, ge=0, le=255, description="points below are left out")
    min_views: int = Field(default=0, ge=0, le=255, description="points on which fewer views agree are left out")
    voxel: float = Field(
        default=0.0, ge=0, description="keep the best point of each voxel of this edge, scene units; 0: keep all"
    )
    max_points: int = Field(
        default=0, ge=0, description="thin evenly to this number of points or a little fewer; 0: no limit"
    )


class LasParams(CloudParams):
    """Settings of export.las."""

    format: Literal["las", "laz"] = Field(default="laz", description="plain, or compressed without loss")
    step: float = Field(default=0.0001, gt=0, description="of the coordinates, which are whole numbers of it")


@stage("export.las")
def las(cloud: One[PointCloud], poses: One[Poses], params: LasParams, ctx: Context) -> Files:
    """The fused cloud as cloud.laz (or .las): LAS 1.4 with 16-bit colours, z up; normals, views and confidence too."""
    kept, placement = _prepared(cloud, poses, params, ctx)
    path = ctx.scratch / f"cloud.{params.format}"
    write_las(path, cloud, placement, step=params.step, kept=kept)
    return Files({path.name: path})


@stage("export.e57")
def e57(cloud: One[PointCloud], poses: One[Poses], params: CloudParams, ctx: Context) -> Files:
    """The fused cloud as cloud.e57: one scan with colours and normals, z up."""
    kept, placement = _prepared(cloud, poses, params, ctx)
    path = ctx.scratch / "cloud.e57"
    write_e57(path, cloud, placement, kept=kept)
    return Files({path.name: path})


def _prepared(cloud: PointCloud, poses: Poses, params: CloudParams, ctx: Context) -> tuple[Kept | None, Placement]:
    """Return which points are written and where, and report both."""
    placement = placement_of(poses, params.epsg)
    selection = Selection(params.min_confidence, params.min_views, params.voxel, params.max_points)
    kept = select_points(cloud, selection, ctx.scratch)
    count = len(cloud) if kept is None else kept.count
    if not count:
        raise InputError("the cloud has no points that could be written")
    ctx.metric("points", count)
    if placement.crs is not None:
        ctx.note(f"the cloud is on the map {placement.crs.name} (EPSG:{placement.crs.to_epsg()})")
    return kept, placement
