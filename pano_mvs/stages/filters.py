"""Filters: they take and return range maps, and can be combined in any order."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.filters.bilateral_solver import fast_bilateral_solver
from pano_mvs.algorithms.filters.consistency import checked_with_agreement
from pano_mvs.algorithms.filters.data_term import require_confidence
from pano_mvs.algorithms.filters.fill import fill_from_neighbours
from pano_mvs.algorithms.filters.guided import guided_range
from pano_mvs.algorithms.filters.planes import lay_planes
from pano_mvs.algorithms.filters.smoothing import gaussian_range, median_range, remove_speckles
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.masks.areas import share_of_sphere
from pano_mvs.algorithms.masks.sky import MAX_SOURCES, sky_pixels
from pano_mvs.algorithms.patchmatch.exchange import respect_free_space
from pano_mvs.algorithms.scales import sharp_halvings
from pano_mvs.api import (
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
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.scene.upright import WORLD_UP


def bytes_per_pixel(own: int, *, each_source: int = 0) -> Callable[[Params, Mapping[str, Any]], int]:
    """Return a function that computes the memory of a unit with a port `range_map` and, optionally, `sources`."""

    def needed(_: Params, inputs: Mapping[str, Any]) -> int:
        pixels: int = inputs["range_map"].range.size
        return pixels * (own + each_source * len(inputs.get("sources", ())))

    return needed


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
    poses: One[Poses],
    params: SkyParams,
    ctx: Context,
) -> RangeMap:
    """Find the sky and remove its ranges; use it after filters.consistency. No later stage gives the sky a range.

    Ranges that other views confirm stay where a parallax shows them, and below the horizon after poses.level.
    """
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
            up=pose.cam_from_world.rotation @ WORLD_UP if poses.worlds[pose.group].axes.is_level else None,
        )
        found = found if range_map.sky is None else found | range_map.sky
        result = with_ranges(replace(range_map, sky=found), range_map.range)
        ctx.metric("sky", share_of_sphere(found))
    ctx.metric("completeness", float(result.valid.mean()))
    ctx.metric("consistent", float((result.confidence >= CONSISTENT_CONFIDENCE[0]).mean()))
    return result


@stage("filters.median", settings=median_range)
def median(range_map: Each[RangeMap], params: Params, ctx: Context) -> RangeMap:
    """Replace each valid range by the median of the valid ranges in a window; invalid pixels stay invalid."""
    return _measured(median_range(range_map, **arguments_from(median_range, params)), ctx)


@stage("filters.gaussian", settings=gaussian_range)
def gaussian(range_map: Each[RangeMap], params: Params, ctx: Context) -> RangeMap:
    """Smooth valid ranges by a Gaussian window; invalid pixels stay invalid."""
    return _measured(gaussian_range(range_map, **arguments_from(gaussian_range, params)), ctx)


@stage("filters.guided", settings=guided_range)
def guided(range_map: Each[RangeMap], image: Each[Panorama], params: Params, ctx: Context) -> RangeMap:
    """Smooth ranges by the guided filter, preserving edges of the panorama. Masked pixels get no range."""
    smoothed = guided_range(range_map, image.load(), **arguments_from(guided_range, params))
    return _measured(_unmasked(smoothed, image), ctx)


@stage("filters.confidence", settings=require_confidence)
def confidence(range_map: Each[RangeMap], params: Params, ctx: Context) -> RangeMap:
    """Remove pixels of low confidence: by default all pixels that no other view confirms."""
    return _measured(require_confidence(range_map, **arguments_from(require_confidence, params)), ctx)


@stage("filters.speckle", settings=remove_speckles)
def speckle(range_map: Each[RangeMap], params: Params, ctx: Context) -> RangeMap:
    """Remove small isolated surfaces."""
    cleaned = remove_speckles(range_map, **arguments_from(remove_speckles, params))
    return _measured(cleaned, ctx)


@params_from(checked_with_agreement)
class ConsistencyParams(Params):
    """Settings of filters.consistency."""

    scale: Literal["sharp", "nominal"] = Field(
        default="sharp",
        description="pixels of max_reprojection_px: of the resolution at which the panorama is sharp, or of its own",
    )


@stage("filters.consistency", memory=bytes_per_pixel(160, each_source=8))
def consistency(
    range_map: Each[RangeMap],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_poses: Near[Pose],
    image: Each[Panorama] | None,
    params: ConsistencyParams,
    ctx: Context,
) -> RangeMap:
    """Compare ranges with those of neighbouring views, forward and backward; confirmed ones get confidence 128–255."""
    require_one_group(pose, source_poses)
    settings = arguments_from(checked_with_agreement, params)
    if image is not None and params.scale == "sharp":
        settings["max_reprojection_px"] *= 1 << sharp_halvings(image.load())
    checked, agreement = checked_with_agreement(
        range_map,
        pose.cam_from_world,
        sources,
        source_poses=[other.cam_from_world for other in source_poses],
        **settings,
    )
    for name, value in asdict(agreement).items():
        ctx.metric(name, value)
    return _measured(checked, ctx)


@stage("filters.free_space", settings=respect_free_space, memory=bytes_per_pixel(150, each_source=40))
def free_space(
    range_map: Each[RangeMap],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_poses: Near[Pose],
    params: Params,
    ctx: Context,
) -> RangeMap:
    """Correct unconfirmed ranges by confirmed ones of other views: those behind a point, and those seen through.

    Use it after filters.consistency, and a filter that fills holes after it.
    """
    require_one_group(pose, source_poses)
    corrected, hidden, seen_through = respect_free_space(
        range_map,
        pose.cam_from_world,
        sources,
        source_poses=[other.cam_from_world for other in source_poses],
        **arguments_from(respect_free_space, params),
    )
    ctx.metric("hidden", hidden)
    ctx.metric("seen_through", seen_through)
    return _measured(corrected, ctx)


class ScaleRangesParams(Params):
    """Settings of filters.scale and depth.scale_planes."""

    factor: float = Field(default=1.0, gt=0, description="new units per unit before, such as metres")
    group: int = Field(default=0, ge=0, description="group of the poses that is scaled; 0 is the largest")


@stage("filters.scale", memory=bytes_per_pixel(30))
def scale_ranges(range_map: Each[RangeMap], pose: Each[Pose], params: ScaleRangesParams, ctx: Context) -> RangeMap:
    """Multiply all ranges by a factor, for results whose scale is known only afterwards; see `pano-mvs scale`."""
    if pose.group != params.group:
        return _measured(range_map, ctx)
    return _measured(replace(range_map, range=range_map.range * np.float32(params.factor)), ctx)


@stage("filters.fast_bilateral_solver", settings=fast_bilateral_solver, memory=bytes_per_pixel(190))
def bilateral_solver(range_map: Each[RangeMap], image: Each[Panorama], params: Params, ctx: Context) -> RangeMap:
    """Smooth ranges by the Fast Bilateral Solver, preserving edges of the panorama.

    Masked pixels get no range, even with `fill`.
    """
    solved = fast_bilateral_solver(range_map, image.load(), **arguments_from(fast_bilateral_solver, params))
    return _measured(_unmasked(solved, image), ctx)


@stage("filters.fill", settings=fill_from_neighbours, memory=bytes_per_pixel(96))
def fill(range_map: Each[RangeMap], image: Each[Panorama], params: Params, ctx: Context) -> RangeMap:
    """Fill holes with the range of the background surface, from reliable pixels (filled pixels: confidence 3–63).

    Masked pixels get no range.
    """
    filled = fill_from_neighbours(range_map, **arguments_from(fill_from_neighbours, params))
    return _measured(_unmasked(filled, image), ctx)


@stage("filters.planes", settings=lay_planes, memory=bytes_per_pixel(170))
def planes(range_map: Each[RangeMap], image: Each[Panorama], params: Params, ctx: Context) -> RangeMap:
    """Fit planes to plain walls and ceilings, where nothing can be matched; use it after the bilateral solver.

    Masked pixels get no range.
    """
    laid = lay_planes(range_map, image.load(), rng=ctx.rng, **arguments_from(lay_planes, params))
    return _measured(_unmasked(laid, image), ctx)


def _unmasked(range_map: RangeMap, image: Panorama) -> RangeMap:
    valid = image.load_mask()
    ranges: NDArray[np.float32] = np.where(valid, range_map.range, np.float32(np.nan))
    return with_ranges(range_map, ranges, np.where(valid, range_map.confidence, np.uint8(0)))


def _measured(range_map: RangeMap, ctx: Context) -> RangeMap:
    ctx.metric("completeness", float(range_map.valid.mean()))
    confirmed = range_map.confidence >= CONSISTENT_CONFIDENCE[0]
    ctx.metric("consistent", float(confirmed.mean()))
    quarter = max(1, len(confirmed) // 4)
    for side, rows in (("above", slice(0, quarter)), ("below", slice(-quarter, None))):
        weights = pixel_solid_angle(confirmed.shape)[rows, None]
        valid = float((range_map.valid[rows] * weights).mean())
        # Of what is above or below a camera, at least this share must have a range, or it is a sky or masked.
        if valid >= 0.5 * float(weights.mean()):
            ctx.metric(f"confirmed_{side}", float((confirmed[rows] * weights).mean()) / valid)
    return range_map
