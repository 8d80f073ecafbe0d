"""The settings of fusion: which pixels become points, and how points of several views are merged."""

from __future__ import annotations

from dataclasses import dataclass

from pano_mvs.core.settings import check_settings, setting


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """Which pixels become points, and how points of several views are merged.

    The view that contributes a point counts towards `min_views`. A pixel that lacks one view is accepted if at least
    `min_support` of the window around it is confirmed and on the same surface, and no view contradicts it. Points are
    averaged with Tukey's biweight of their relative difference and, if the range maps have an uncertainty, by their
    precision; `max_uncertainty` and `smooth` have no effect without one. Pixels below `min_confidence` contribute no
    points either. With `max_footprint_ratio` 1, each part of the surface is contributed by one view only.
    """

    min_views: int = setting(2, ge=1, doc="minimum number of views that agree on a point")
    max_relative_error: float = setting(0.02, gt=0, doc="maximum relative difference of ranges that agree")
    min_support: float | None = setting(
        0.1, gt=0, le=1, doc="confirmed share of the surface around a pixel that replaces one missing view"
    )
    merge_within: float = setting(0.01, ge=0, doc="average points of views with a smaller relative difference")
    max_footprint_ratio: float = setting(
        4.0, ge=1, doc="leave a point to another view that sees it this much better; 1: no duplicate points"
    )
    max_uncertainty: float | None = setting(
        0.16, gt=0, doc="maximum standard deviation of a point relative to its range, where it is known"
    )
    smooth: bool = setting(True, doc="move points to the planes of their neighbours, within their standard deviation")
    even_density: bool = setting(True, doc="thin rows away from the equator to even density per solid angle")
    stride: int = setting(1, ge=1, doc="use every stride-th pixel in both directions")
    min_confidence: int = setting(64, ge=1, le=255, doc="minimum confidence of pixels (64: seen, 128: consistent)")
    neighbours: int = setting(8, ge=0, doc="number of nearest views to compare each view with")
    voxel_size: float | None = setting(None, gt=0, doc="thin to one point per voxel of this edge, in scene units")

    def __post_init__(self) -> None:
        """Raise UsageError if a setting is out of bounds."""
        check_settings(self)
