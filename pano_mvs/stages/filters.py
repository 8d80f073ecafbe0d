"""Filters: they take and return range maps, and can be combined in any order."""

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

    window: Odd = Field(default=5, ge=3, le=15, description="side length in pixels, odd")


@stage("filters.median")
def median(range_map: Each[RangeMap], params: MedianParams, ctx: Context) -> RangeMap:
    """Replace each valid range by the median of the valid ranges in a window; invalid pixels stay invalid."""
    return _measured(median_range(range_map, window=params.window), ctx)


class GaussianParams(Params):
    """Settings of filters.gaussian."""

    window: Odd = Field(default=5, ge=3, le=15, description="side length in pixels, odd")
    sigma_px: float = Field(default=1.1, gt=0, description="standard deviation in pixels (the paper: 1.1)")


@stage("filters.gaussian")
def gaussian(range_map: Each[RangeMap], params: GaussianParams, ctx: Context) -> RangeMap:
    """Smooth valid ranges by a Gaussian window; invalid pixels stay invalid."""
    return _measured(gaussian_range(range_map, window=params.window, sigma_px=params.sigma_px), ctx)


class GuidedParams(Params):
    """Settings of filters.guided."""

    radius: int = Field(default=4, ge=1, description="radius of the windows, in pixels at the equator")
    epsilon: float = Field(default=4.0, gt=0, description="contrast in grey levels above which edges are preserved")
    domain: Literal["range", "inverse"] = Field(default="inverse", description="quantity to smooth: range or 1/range")
    fill: bool = Field(default=False, description="fill pixels near valid ones (confidence 1–63)")


@stage("filters.guided")
def guided(range_map: Each[RangeMap], image: Each[Panorama], params: GuidedParams, ctx: Context) -> RangeMap:
    """Smooth ranges by the guided filter, preserving edges of the panorama. Masked pixels get no range."""
    smoothed = guided_range(range_map, image.load(), **params.model_dump())
    return _measured(_unmasked(smoothed, image), ctx)


class ConfidenceParams(Params):
    """Settings of filters.confidence."""

    min_confidence: int = Field(default=128, ge=1, le=255, description="minimum confidence; 128: confirmed pixels")


@stage("filters.confidence")
def confidence(range_map: Each[RangeMap], params: ConfidenceParams, ctx: Context) -> RangeMap:
    """Remove pixels of low confidence: by default all pixels that no other view confirms."""
    return _measured(require_confidence(range_map, min_confidence=params.min_confidence), ctx)


class SpeckleParams(Params):
    """Settings of filters.speckle."""

    max_size_px: float = Field(default=60.0, gt=0, description="remove smaller surfaces; area in pixels at the equator")
    max_relative_step: float = Field(
        default=0.03, gt=0, description="maximum relative step between pixels of one surface"
    )


@stage("filters.speckle")
def speckle(range_map: Each[RangeMap], params: SpeckleParams, ctx: Context) -> RangeMap:
    """Remove small isolated surfaces."""
    cleaned = remove_speckles(range_map, max_size_px=params.max_size_px, max_relative_step=params.max_relative_step)
    return _measured(cleaned, ctx)


class ConsistencyParams(Params):
    """Settings of filters.consistency."""

    max_relative_error: float = Field(
        default=0.02, gt=0, description="maximum relative difference of ranges that agree"
    )
    max_reprojection_px: float = Field(default=1.0, gt=0, description="maximum forward-backward reprojection error")
    min_support: float = Field(
        default=0.85, ge=0, description="minimum sum over sources of (1 - (error / max_reprojection_px)²)² for a pixel"
    )
    min_motion_px: float = Field(
        default=0.05,
        ge=0,
        description="minimum motion of a pixel in the sources if its range changes by max_relative_error",
    )
    min_views: int = Field(default=1, ge=1, description="minimum number of sources that confirm a pixel")
    remove_inconsistent: bool = Field(
        default=False, description="remove pixels that no source confirms and several contradict"
    )
    min_contradictions: int = Field(default=2, ge=1, description="number of contradicting sources for removal")


@stage("filters.consistency", memory=bytes_per_pixel(112, each_source=8))
def consistency(
    range_map: Each[RangeMap],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_poses: Near[Pose],
    params: ConsistencyParams,
    ctx: Context,
) -> RangeMap:
    """Compare ranges with those of neighbouring views, forward and backward; confirmed ones get confidence 128–255."""
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

    sigma_spatial: float = Field(default=8.0, ge=1, description="size of spatial cells, in pixels at the equator")
    sigma_luma: float = Field(default=8.0, ge=2.1, description="size of luma bins, in grey levels")
    sigma_chroma: float = Field(default=8.0, ge=2.1, description="size of chroma bins, in grey levels")
    smoothness: float = Field(
        default=1.0, ge=0, description="λ: weight of smoothness relative to a pixel of full confidence"
    )
    domain: Literal["range", "inverse"] = Field(default="inverse", description="quantity to smooth: range or 1/range")
    fill: bool = Field(default=True, description="fill pixels without a range (confidence 1–63)")
    max_hole_deg: float = Field(
        default=20.0, ge=0, description="larger holes, such as a sky, are not filled (diameter of a disc); 0: fill all"
    )
    keep_confidence: int = Field(
        default=128, ge=1, le=256, description="pixels with at least this confidence keep their range; 256: smooth all"
    )


@stage("filters.fast_bilateral_solver", memory=bytes_per_pixel(190))
def bilateral_solver(
    range_map: Each[RangeMap], image: Each[Panorama], params: BilateralSolverParams, ctx: Context
) -> RangeMap:
    """Smooth ranges by the Fast Bilateral Solver, preserving edges of the panorama.

    Masked pixels get no range, even with `fill`.
    """
    solved = fast_bilateral_solver(range_map, image.load(), **params.model_dump())
    return _measured(_unmasked(solved, image), ctx)


class FillParams(Params):
    """Settings of filters.fill."""

    max_distance_px: int = Field(default=48, ge=1, description="search distance, in pixels at the equator")
    min_confidence: int = Field(default=128, ge=1, le=255, description="minimum confidence of pixels to fill from")
    max_hole_deg: float = Field(
        default=20.0, ge=0, description="larger holes, such as a sky, are not filled (diameter of a disc); 0: fill all"
    )


@stage("filters.fill", memory=bytes_per_pixel(96))
def fill(range_map: Each[RangeMap], image: Each[Panorama], params: FillParams, ctx: Context) -> RangeMap:
    """Fill holes with the range of the background surface, from reliable pixels only (confidence 1–63).

    Masked pixels get no range.
    """
    filled = fill_from_neighbours(range_map, **params.model_dump())
    return _measured(_unmasked(filled, image), ctx)


class PlanesParams(Params):
    """Settings of filters.planes."""

    contrast: float = Field(
        default=8.0, gt=0, description="maximum contrast around a pixel of a plain surface, grey levels"
    )
    min_area_deg2: float = Field(default=75.0, gt=0, description="minimum area of a surface, in square degrees")
    max_relative_error: float = Field(default=0.02, gt=0, description="maximum relative error of a pixel on the plane")
    min_share: float = Field(default=0.25, gt=0, le=1, description="minimum share of reliable pixels on the plane")
    min_confidence: int = Field(default=128, ge=1, le=255, description="minimum confidence of reliable pixels")
    max_hole_deg: float = Field(
        default=20.0, ge=0, description="larger holes, such as a sky, are not filled (diameter of a disc); 0: fill all"
    )


@stage("filters.planes", memory=bytes_per_pixel(170))
def planes(range_map: Each[RangeMap], image: Each[Panorama], params: PlanesParams, ctx: Context) -> RangeMap:
    """Fit planes to plain walls and ceilings, where nothing can be matched; use it after the bilateral solver.

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
