"""Settings of fusion."""

from __future__ import annotations

from dataclasses import dataclass

from pano_mvs.core.errors import UsageError


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """Which pixels become points, and how points of several views are merged.

    Attributes:
        min_views: number of views, including the one that contributes the point, that must agree on it.
        max_relative_error: maximum relative difference of two views' ranges of one point.
        min_support: a pixel that lacks one view is accepted if at least this share of the window around it is confirmed
            and on the same surface, and no view contradicts it; None: never.
        merge_within: points of two views with a smaller relative difference are averaged with Tukey's biweight of that
            difference; 0 leaves every point where its own view sees it.
        max_footprint_ratio: a view leaves a point to another agreeing view in which a pixel covers a smaller area of
            the surface by more than this factor. 1: each part of the surface is contributed by one view only.
        even_density: whether rows away from the equator are thinned to an even number of points per solid angle.
        stride: use every stride-th pixel in both directions.
        min_confidence: pixels with a lower confidence are ignored.
        neighbours: number of views with the nearest centres to compare a view's pixels with.
        voxel_size: edge, in scene units, of voxels in which points are merged; None: do not merge.
    """

    min_views: int = 2
    max_relative_error: float = 0.02
    min_support: float | None = 0.1
    merge_within: float = 0.01
    max_footprint_ratio: float = 4.0
    even_density: bool = True
    stride: int = 1
    min_confidence: int = 64
    neighbours: int = 8
    voxel_size: float | None = None

    def __post_init__(self) -> None:
        """Raise UsageError if a setting is out of bounds."""
        positive = {
            name: getattr(self, name) for name in ("min_views", "max_relative_error", "stride", "min_confidence")
        }
        wrong = {name: value for name, value in positive.items() if not value > 0}
        if wrong:
            raise UsageError(f"settings of a fusion must be positive, got {wrong}")
        if not self.merge_within >= 0 or not self.max_footprint_ratio >= 1 or self.neighbours < 0:
            raise UsageError(
                f"merge_within and neighbours must be 0 or more, max_footprint_ratio 1 or more, got "
                f"{self.merge_within}, {self.neighbours}, {self.max_footprint_ratio}"
            )
        if self.min_support is not None and not 0 < self.min_support <= 1:
            raise UsageError(f"min_support is a share above 0, or None, got {self.min_support}")
        if self.voxel_size is not None and not self.voxel_size > 0:
            raise UsageError(f"voxel_size must be positive, got {self.voxel_size}")
