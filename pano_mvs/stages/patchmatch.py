"""Refinement of swept ranges by slanted planes."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, stage
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.stages.fields import Odd
from pano_mvs.stages.memory import bytes_per_pixel


class PatchMatchParams(Params):
    """Settings of depth.patchmatch."""

    rounds: int = Field(default=4, ge=0, le=32, description="number of rounds of fitting and matching planes")
    window: Odd = Field(
        default=5, ge=3, le=15, description="samples along each side of the window, two pixels apart, odd"
    )
    prior_px: float = Field(
        default=0.6, gt=0, description="standard deviation of the prior of a plane's range, in pixels of parallax"
    )
    prior_slope: float = Field(
        default=0.1, gt=0, description="standard deviation of the prior of its slope, in pixels of parallax per pixel"
    )
    noise: float = Field(default=0.4, gt=0, description="minimum standard deviation of image noise, in grey levels")
    sigma_color: float = Field(
        default=25.0,
        gt=0,
        description="contrast to the window's centre, in grey levels, at which a sample has half weight",
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
    refined = refine_range(
        range_map,
        ref.load(),
        [source.load() for source in sources],
        [other.cam_from_world @ pose.cam_from_world.inverse() for other in source_poses],
        source_masks=[source.load_mask() for source in sources],
        **params.model_dump(),
    )
    ctx.metric("completeness", float(refined.valid.mean()))
    ctx.metric("sources", len(sources))
    return refined
