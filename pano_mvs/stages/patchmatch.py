"""Slanted planes: refinement of swept ranges, and exchange of ranges between views."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pano_mvs.algorithms.patchmatch.exchange import SourceView, exchange_ranges
from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.algorithms.patchmatch.second_round import refine_at_scale, refine_plain_surfaces
from pano_mvs.algorithms.scales import coarser_levels, sharp_halvings
from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, arguments_from, params_from, stage
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.stages.memory import bytes_per_pixel


@params_from(refine_range)
class PatchMatchParams(Params):
    """Settings of depth.patchmatch."""

    scale: Literal["sharp", "nominal"] = Field(
        default="sharp", description="where to begin: the resolution at which the panorama is sharp, or its own"
    )
    multiscale: bool = Field(
        default=True,
        description="refine panoramas of 2048 columns and more also at half the resolution, down to 1024 columns, for "
        "what shows only noise at the full one; not with scale: nominal",
    )


@stage("depth.patchmatch", memory=bytes_per_pixel(140, each_source=20))
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
    is_nominal = params.scale == "nominal"
    refined = refine_at_scale(
        range_map,
        reference,
        [source.load() for source in sources],
        source_from_reference=[other.cam_from_world @ pose.cam_from_world.inverse() for other in source_poses],
        source_masks=[source.load_mask() for source in sources],
        halvings=0 if is_nominal else sharp_halvings(reference),
        levels=coarser_levels(ref.size_hw) if params.multiscale and not is_nominal else 0,
        **arguments_from(refine_range, params),
    )
    ctx.metric("completeness", float(refined.valid.mean()))
    ctx.metric("sources", len(sources))
    return refined


@stage("depth.plain_surfaces", memory=bytes_per_pixel(150, each_source=20))
def plain_surfaces(
    range_map: Each[RangeMap],
    filtered: Each[RangeMap],
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    params: PatchMatchParams,
    ctx: Context,
) -> RangeMap:
    """Refine pixels without texture again where filters changed their ranges; all other pixels keep theirs.

    `range_map` comes from depth.patchmatch, `filtered` from a consistency check and filters after it.
    """
    require_one_group(pose, source_poses)
    reference = ref.load()
    refined, share = refine_plain_surfaces(
        range_map,
        filtered,
        reference,
        sources=[source.load() for source in sources],
        source_from_reference=[other.cam_from_world @ pose.cam_from_world.inverse() for other in source_poses],
        source_masks=[source.load_mask() for source in sources],
        halvings=sharp_halvings(reference) if params.scale == "sharp" else 0,
        **arguments_from(refine_range, params),
    )
    ctx.metric("completeness", float(refined.valid.mean()))
    ctx.metric("refined", share)
    ctx.metric("sources", len(sources))
    return refined


@params_from(exchange_ranges)
class ExchangeParams(Params):
    """Settings of depth.exchange."""


@stage("depth.exchange", memory=bytes_per_pixel(205, each_source=40))
def exchange(
    range_map: Each[RangeMap],
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_images: Near[Panorama],
    source_poses: Near[Pose],
    params: ExchangeParams,
    ctx: Context,
) -> RangeMap:
    """Give unconfirmed pixels the nearer ranges that other views found, where the images match better.

    Follow it with filters.consistency that compares with the ranges before the exchange (`in: {sources: ...}`):
    otherwise, exchanged ranges confirm each other.
    """
    require_one_group(pose, source_poses)
    views = [
        SourceView(image.load(), source, other.cam_from_world @ pose.cam_from_world.inverse(), image.load_mask())
        for source, image, other in zip(sources, source_images, source_poses, strict=True)
    ]
    exchanged, share = exchange_ranges(range_map, ref.load(), views, **arguments_from(exchange_ranges, params))
    ctx.metric("exchanged", share)
    ctx.metric("sources", len(sources))
    return exchanged
