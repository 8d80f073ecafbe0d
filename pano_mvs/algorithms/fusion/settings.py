"""The settings of a fusion."""

from __future__ import annotations

from dataclasses import dataclass

from pano_mvs.core.settings import check_settings, setting


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """Which pixels become points, and how points of several views become one.

    The view that writes a point counts among `min_views`. A pixel that lacks one view is written all the same if at
    least `min_support` of the window around it is confirmed and of its surface, and no view contradicts it. Points are
    averaged with Tukey's biweight of their relative difference. Pixels below `min_confidence` are not written either.
    With `max_footprint_ratio` 1 each piece of the surface is written by one view alone.
    """

    min_views: int = setting(2, ge=1, doc="views that must agree on a point")
    max_relative_error: float = setting(0.02, gt=0, doc="ranges that agree differ by at most this share")
    min_support: float | None = setting(
        0.1, gt=0, le=1, doc="share of the surface around a pixel that vouches for one missing view"
    )
    merge_within: float = setting(0.01, ge=0, doc="points of views that differ by less are averaged")
    max_footprint_ratio: float = setting(
        4.0, ge=1, doc="a view leaves to another what that sees this much better; 1: no point twice"
    )
    even_density: bool = setting(True, doc="thin rows away from the equator to points per solid angle")
    stride: int = setting(1, ge=1, doc="write every stride-th pixel in both directions")
    min_confidence: int = setting(64, ge=1, le=255, doc="pixels below have no vote (64: seen, 128: consistent)")
    neighbours: int = setting(8, ge=0, doc="views, the nearest ones, that vote on a view's pixels")
    voxel_size: float | None = setting(None, gt=0, doc="thin to one point per cube, in scene units")

    def __post_init__(self) -> None:
        """Raise UsageError if a setting is out of bounds."""
        check_settings(self)
