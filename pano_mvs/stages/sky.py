"""The sky: pixels of range maps that show no surface."""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field

from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.masks.areas import share_of_sphere
from pano_mvs.algorithms.masks.sky import MAX_SOURCES, sky_pixels
from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, arguments_from, params_from, stage
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.stages.memory import bytes_per_pixel


@params_from(sky_pixels, own_last=True)
class SkyParams(Params):
    """Settings of filters.sky."""

    enabled: bool = Field(default=True, description="false returns the range maps unchanged")


@stage("filters.sky", memory=bytes_per_pixel(150, each_source=4))
def sky(
    range_map: Each[RangeMap],
    image: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    params: SkyParams,
    ctx: Context,
) -> RangeMap:
    """Find the sky and remove its ranges; use it after filters.consistency. No later stage gives the sky a range."""
    require_one_group(pose, source_poses)
    result = range_map
    if params.enabled:
        used = list(zip(sources, source_poses, strict=True))[:MAX_SOURCES]
        found = sky_pixels(
            range_map,
            image.load(),
            [source.load() for source, _ in used],
            source_from_reference=[other.cam_from_world @ pose.cam_from_world.inverse() for _, other in used],
            valid=image.load_mask(),
            source_valid=[source.load_mask() for source, _ in used],
            rng=ctx.rng,
            **arguments_from(sky_pixels, params),
        )
        found = found if range_map.sky is None else found | range_map.sky
        result = with_ranges(replace(range_map, sky=found), range_map.range)
        ctx.metric("sky", share_of_sphere(found))
    ctx.metric("completeness", float(result.valid.mean()))
    ctx.metric("consistent", float((result.confidence >= CONSISTENT_CONFIDENCE[0]).mean()))
    return result
