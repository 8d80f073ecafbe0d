"""Refinement of swept ranges by slanted planes."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.algorithms.patchmatch.sharp_refine import refine_at_scale
from pano_mvs.algorithms.sharp_scale import sharp_halvings
from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, arguments_from, params_from, stage
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.stages.memory import bytes_per_pixel


@params_from(refine_range)
class PatchMatchParams(Params):
    """Settings of depth.patchmatch."""

    scale: Literal["sharp", "nominal"] = Field(
        default="sharp", description="where to begin: the resolution at which the panorama is sharp, or its own"
    )


@stage("depth.patchmatch", memory=bytes_per_pixel(140, each_source=16))
def patchmatch(
    range_map: Each[RangeMap],
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    params: PatchMatchParams,
    ctx: Context,
) -> RangeMap:
    """Fit slanted planes to the ranges and move them to where the images match best; also gives normals."""
    require_one_group(pose, source_poses)
    reference = ref.load()
    refined = refine_at_scale(
        range_map,
        reference,
        [source.load() for source in sources],
        [other.cam_from_world @ pose.cam_from_world.inverse() for other in source_poses],
        source_masks=[source.load_mask() for source in sources],
        halvings=sharp_halvings(reference) if params.scale == "sharp" else 0,
        **arguments_from(refine_range, params),
    )
    ctx.metric("completeness", float(refined.valid.mean()))
    ctx.metric("sources", len(sources))
    return refined
