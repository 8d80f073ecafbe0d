"""Filters: range map in, range map out, in any order."""

from __future__ import annotations

from dataclasses import asdict
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.filters.bilateral_solver import fast_bilateral_solver
from pano_mvs.algorithms.filters.confidence import require_confidence
from pano_mvs.algorithms.filters.consistency import checked_with_agreement
from pano_mvs.algorithms.filters.fill import fill_from_neighbours
from pano_mvs.algorithms.filters.gaussian import gaussian_range
from pano_mvs.algorithms.filters.guided import guided_range
from pano_mvs.algorithms.filters.median import median_range
from pano_mvs.algorithms.filters.planes import lay_planes
from pano_mvs.algorithms.filters.replacement import with_ranges
from pano_mvs.algorithms.filters.speckle import remove_speckles
from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, stage
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.stages.fields import Odd
from pano_mvs.stages.memory import bytes_per_pixel


class MedianParams(Params):
    """Settings of filters.median."""

    window: Odd = Field(default=5, ge=3, le=15, description="side in pixels, odd")


@stage("filters.median")
def median(range_map: Each[RangeMap], params: MedianParams, ctx: Context) -> RangeMap:
    """Median of the valid ranges in a window; invalid pixels stay invalid."""
    return _measured(median_range(range_map, window=params.window), ctx)


class GaussianParams(Params):
    """Settings of filters.gaussian."""

    window: Odd = Field(default=5, ge=3, le=15, description="side in pixels, odd")
    sigma_px: float = Field(default=1.1, gt=0, description="width in pixels (the paper: 1.1)")


@stage("filters.gaussian")
def gaussian(range_map: Each[RangeMap], params: GaussianParams, ctx: Context) -> RangeMap:
    """Gaussian mean of the valid ranges in a window; invalid pixels stay invalid."""
    return _measured(gaussian_range(range_map, window=params.window, sigma_px=params.sigma_px), ctx)


class GuidedParams(Params):
    """Settings of filters.guided."""

    radius: int = Field(default=4, ge=1, description="of the windows, in pixels at the equator")
    epsilon: float = Field(default=4.0, gt=0, description="grey levels: larger contrasts are edges")
    domain: Literal["range", "inverse"] = Field(default="inverse", description="what is smoothed: range or 1/range")
    fill: bool = Field(default=False, description="give a range to pixels near valid ones (confidence 1–63)")


@stage("filters.guided")
def guided(range_map: Each[RangeMap], image: Each[Panorama], params: GuidedParams, ctx: Context) -> RangeMap:
    """The guided filter: in every window ranges follow the colours of the picture. Masked pixels get no range."""
    smoothed = guided_range(range_map, image.load(), **params.model_dump())
    return _measured(_unmasked(smoothed, image), ctx)


class ConfidenceParams(Params):
    """Settings of filters.confidence."""

    min_confidence: int = Field(default=128, ge=1, le=255, description="pixels below are removed; 128: confirmed ones")


@stage("filters.confidence")
def confidence(range_map: Each[RangeMap], params: ConfidenceParams, ctx: Context) -> RangeMap:
    """Remove what is not sure enough: by default all that no other view confirms."""
    return _measured(require_confidence(range_map, min_confidence=params.min_confidence), ctx)


class SpeckleParams(Params):
    """Settings of filters.speckle."""

    max_size_px: float = Field(default=60.0, gt=0, description="smaller islands are removed; in pixels at the equator")
    max_relative_step: float = Field(default=0.03, gt=0, description="neighbours of one surface differ by at most this")


@stage("filters.speckle")
def speckle(range_map: Each[RangeMap], params: SpeckleParams, ctx: Context) -> RangeMap:
    """Remove small islands that hang in the air."""
    cleaned = remove_speckles(range_map, max_size_px=params.max_size_px, max_relative_step=params.max_relative_step)
    return _measured(cleaned, ctx)


class ConsistencyParams(Params):
    """Settings of filters.consistency."""

    max_relative_error: float = Field(default=0.02, gt=0, description="ranges that agree differ by at most this share")
    max_reprojection_px: float = Field(default=1.0, gt=0, description="forward and back may miss the pixel by this")
    min_support: float = Field(
        default=0.85, ge=0, description="sum over sources of (1 - (miss / max_reprojection_px)²)² that a pixel needs"
    )
    min_motion_px: float = Field(
        default=0.05, ge=0, description="a change by max_relative_error must move a pixel by this in the sources"
    )
    min_views: int = Field(default=1, ge=1, description="sources that must confirm a pixel")
    remove_inconsistent: bool = Field(
        default=False, description="remove what no source confirms and several contradict"
    )
    min_contradictions: int = Field(default=2, ge=1, description="sources that must contradict for that")


@stage("filters.consistency", memory=bytes_per_pixel(112, each_source=8))
def consistency(
    range_map: Each[RangeMap],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_poses: Near[Pose],
    params: ConsistencyParams,
    ctx: Context,
) -> RangeMap:
    """Compare each range with those of the neighbours, forward and back: confidence 128–255 where they confirm it."""
    require_one_group(pose, source_poses)
    checked, agreement = checked_with_agreement(
        range_map,
        pose.cam_from_world,
        sources,
        [other.cam_from_world for other in source_poses],
        **params.model_dump(),
    )
    for name, value in asdict(agreement).items():
        ctx.metric(name, value)
    return _measured(checked, ctx)


class BilateralSolverParams(Params):
    """Settings of filters.fast_bilateral_solver."""

    sigma_spatial: float = Field(default=8.0, ge=1, description="spatial cells, in pixels at the equator")
    sigma_luma: float = Field(default=8.0, ge=2.1, description="luma bins, in grey levels")
    sigma_chroma: float = Field(default=8.0, ge=2.1, description="chroma bins, in grey levels")
    smoothness: float = Field(
        default=1.0, ge=0, description="λ: weight of smoothness against a pixel of full confidence"
    )
    domain: Literal["range", "inverse"] = Field(default="inverse", description="what is smoothed: range or 1/range")
    fill: bool = Field(default=True, description="give a range to pixels that had none (confidence 1–63)")
    max_hole_deg: float = Field(
        default=20.0, ge=0, description="larger holes, such as a sky, stay holes (diameter of a disc); 0 fills all"
    )
    keep_confidence: int = Field(
        default=128, ge=1, le=256, description="pixels of at least this confidence keep their range; 256 smooths all"
    )


@stage("filters.fast_bilateral_solver", memory=bytes_per_pixel(190))
def bilateral_solver(
    range_map: Each[RangeMap], image: Each[Panorama], params: BilateralSolverParams, ctx: Context
) -> RangeMap:
    """The Fast Bilateral Solver: smooth where the picture is smooth, edges where it has edges.

    Masked pixels get no range, whatever `fill` says.
    """
    solved = fast_bilateral_solver(range_map, image.load(), **params.model_dump())
    return _measured(_unmasked(solved, image), ctx)


class FillParams(Params):
    """Settings of filters.fill."""

    max_distance_px: int = Field(default=48, ge=1, description="how far to look, in pixels at the equator")
    min_confidence: int = Field(default=128, ge=1, le=255, description="pixels below are not trusted")
    max_hole_deg: float = Field(
        default=20.0, ge=0, description="larger holes, such as a sky, stay holes (diameter of a disc); 0 fills all"
    )


@stage("filters.fill", memory=bytes_per_pixel(96))
def fill(range_map: Each[RangeMap], image: Each[Panorama], params: FillParams, ctx: Context) -> RangeMap:
    """Give holes the range of the surface behind them, from trusted pixels only (confidence 1–63).

    Masked pixels get no range.
    """
    filled = fill_from_neighbours(range_map, **params.model_dump())
    return _measured(_unmasked(filled, image), ctx)


class PlanesParams(Params):
    """Settings of filters.planes."""

    contrast: float = Field(default=8.0, gt=0, description="grey levels around a pixel of a plain surface, at most")
    min_area_deg2: float = Field(default=75.0, gt=0, description="smaller surfaces are left, in square degrees")
    max_relative_error: float = Field(default=0.02, gt=0, description="pixels on a plane differ by at most this share")
    min_share: float = Field(default=0.25, gt=0, le=1, description="of the trusted pixels that must lie on the plane")
    min_confidence: int = Field(default=128, ge=1, le=255, description="pixels below are not trusted")
    max_hole_deg: float = Field(
        default=20.0, ge=0, description="larger holes, such as a sky, stay holes (diameter of a disc); 0 fills all"
    )


@stage("filters.planes", memory=bytes_per_pixel(170))
def planes(range_map: Each[RangeMap], image: Each[Panorama], params: PlanesParams, ctx: Context) -> RangeMap:
    """Lay planes through plain walls and ceilings, on which nothing can be matched; best after the bilateral solver.

    Masked pixels get no range.
    """
    laid = lay_planes(range_map, image.load(), rng=ctx.rng, **params.model_dump())
    return _measured(_unmasked(laid, image), ctx)


def _unmasked(range_map: RangeMap, image: Panorama) -> RangeMap:
    valid = image.load_mask()
    ranges: NDArray[np.float32] = np.where(valid, range_map.range, np.float32(np.nan))
    return with_ranges(range_map, ranges, np.where(valid, range_map.confidence, np.uint8(0)))


def _measured(range_map: RangeMap, ctx: Context) -> RangeMap:
    ctx.metric("completeness", float(range_map.valid.mean()))
    ctx.metric("consistent", float((range_map.confidence >= CONSISTENT_CONFIDENCE[0]).mean()))
    return range_map
