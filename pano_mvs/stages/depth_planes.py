"""Planes of a whole place: find them in all range maps, and move pixels that show them to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.structure.laid import OtherView
from pano_mvs.algorithms.structure.lay import MAX_LAID_SOURCES, lay_structure
from pano_mvs.algorithms.structure.planes import find_structure
from pano_mvs.algorithms.structure.view import grid_rows
from pano_mvs.api import (
    All,
    Context,
    Each,
    Near,
    One,
    Panorama,
    Params,
    Pose,
    Poses,
    RangeMap,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.scene.surfaces import Structure
from pano_mvs.stages.filters import ScaleRangesParams, bytes_per_pixel


@stage("depth.scene_planes", settings=find_structure)
def scene_planes(
    poses: One[Poses], ranges: All[RangeMap], images: All[Panorama], params: Params, ctx: Context
) -> Structure:
    """Find the level and upright planes of a place in all range maps, and the mirrors on these.

    Planes are placed by the lines where they meet. A mirror is where the pictures show, differently in each view, what
    the room in front of a plane predicts.

    Use it after poses.level: without known gravity, there are none.
    """
    found = find_structure(
        poses,
        ranges,
        lambda name: images[name].load(),
        rng=ctx.rng,
        threads=ctx.threads,
        **arguments_from(find_structure, params),
    )
    ctx.metric("planes", len(found))
    ctx.metric("mirrors", len(found.mirror_corners))
    return found


@params_from(lay_structure, own_last=True)
class StructureParams(Params):
    """Settings of depth.structure."""

    enabled: bool = Field(default=True, description="false returns the range maps unchanged")


def _structure_memory(params: Params, inputs: Mapping[str, Any]) -> int:
    rows = grid_rows(inputs["range_map"].range.shape[0])
    on_grid = 2 * rows * rows * (400 + 20 * len(inputs["planes"]))
    return on_grid + bytes_per_pixel(200, each_source=12)(params, inputs)


@stage("depth.structure", memory=_structure_memory)
def structure(
    range_map: Each[RangeMap],
    image: Each[Panorama],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_poses: Near[Pose],
    source_images: Near[Panorama],
    planes: One[Structure],
    params: StructureParams,
    ctx: Context,
) -> RangeMap:
    """Move pixels to the planes of depth.scene_planes that they show, unless other views contradict.

    Confirmed pixels with texture move only a little, those without texture farther. Masked pixels get no range. Mirrors
    get the range of their pane, and confidence 1; windows that of their wall, and confidence 2.
    """
    require_one_group(pose, source_poses)
    result, share = range_map, 0.0
    if params.enabled and len(planes):
        used = list(zip(sources, source_poses, source_images, strict=True))[:MAX_LAID_SOURCES]
        result, share = lay_structure(
            range_map,
            image.load(),
            planes,
            cam_from_world=pose.cam_from_world,
            sources=[
                OtherView(ranges, other.cam_from_world, source.load(), source.load_mask())
                for ranges, other, source in used
            ],
            group=pose.group,
            valid=image.load_mask(),
            **arguments_from(lay_structure, params),
        )
    ctx.metric("on_planes", share)
    ctx.metric("completeness", float(result.valid.mean()))
    ctx.metric("consistent", float((result.confidence >= CONSISTENT_CONFIDENCE[0]).mean()))
    return result


@stage("depth.scale_planes")
def scale_planes(planes: One[Structure], params: ScaleRangesParams, ctx: Context) -> Structure:
    """Multiply planes and mirrors by a factor, for results whose scale is known only later; see `pano-mvs scale`."""
    scaled, mirrors = (groups == params.group for groups in (planes.group_idx, planes.mirror_group_idx))
    ctx.metric("planes", len(planes))
    ctx.metric("mirrors", len(planes.mirror_corners))
    return replace(
        planes,
        offsets=np.where(scaled, params.factor, 1.0) * planes.offsets,
        mirror_corners=np.where(mirrors, params.factor, 1.0)[:, None, None] * planes.mirror_corners,
    )
