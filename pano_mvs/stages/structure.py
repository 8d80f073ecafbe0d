"""Structure: the planes of a place, and range maps with them."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.structure.lay import lay_structure
from pano_mvs.algorithms.structure.structure import find_structure
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
from pano_mvs.scene.structure import Structure
from pano_mvs.stages.memory import bytes_per_pixel


@params_from(find_structure)
class ScenePlanesParams(Params):
    """Settings of depth.scene_planes."""


@stage("depth.scene_planes")
def scene_planes(
    poses: One[Poses], ranges: All[RangeMap], images: All[Panorama], params: ScenePlanesParams, ctx: Context
) -> Structure:
    """Find the level and upright planes of a place in all range maps, and place them by the lines where they meet.

    Use it after poses.level: without known gravity, there are none.
    """
    found = find_structure(
        poses,
        ranges,
        lambda name: images[name].load(),
        rng=ctx.rng,
        **arguments_from(find_structure, params),
    )
    ctx.metric("planes", len(found))
    return found


@params_from(lay_structure, own_last=True)
class StructureParams(Params):
    """Settings of depth.structure."""

    enabled: bool = Field(default=True, description="false returns the range maps unchanged")


@stage("depth.structure", memory=bytes_per_pixel(200, each_source=12))
def structure(
    range_map: Each[RangeMap],
    image: Each[Panorama],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_poses: Near[Pose],
    planes: One[Structure],
    params: StructureParams,
    ctx: Context,
) -> RangeMap:
    """Move pixels to the planes of depth.scene_planes that they show, unless other views contradict.

    Confirmed pixels with texture move only a little, those without texture farther. Masked pixels get no range.
    """
    require_one_group(pose, source_poses)
    result, share = range_map, 0.0
    if params.enabled and len(planes):
        result, share = lay_structure(
            range_map,
            image.load(),
            planes,
            cam_from_world=pose.cam_from_world,
            sources=sources,
            source_poses=[other.cam_from_world for other in source_poses],
            group=pose.group,
            valid=image.load_mask(),
            **arguments_from(lay_structure, params),
        )
    ctx.metric("on_planes", share)
    ctx.metric("completeness", float(result.valid.mean()))
    ctx.metric("consistent", float((result.confidence >= CONSISTENT_CONFIDENCE[0]).mean()))
    return result
