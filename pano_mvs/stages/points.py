"""Evenly distributed points from all range maps, with the views that see them."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.points.samples import sample_surface
from pano_mvs.algorithms.points.tracking import track_points
from pano_mvs.api import All, Context, Each, One, Panorama, Params, Poses, RangeMap, stage
from pano_mvs.core.text import plural
from pano_mvs.scene.surface_samples import SurfaceSamples
from pano_mvs.scene.tracked_points import TrackedPoints


class SurfaceParams(Params):
    """Settings of points.surface."""

    count: int = Field(default=80_000, ge=1, description="number of evenly spread directions to sample in each view")
    min_confidence: int = Field(default=128, ge=1, le=255, description="minimum confidence of ranges (128: consistent)")


@stage("points.surface")
def surface(image: Each[Panorama], range_map: Each[RangeMap], params: SurfaceParams, ctx: Context) -> SurfaceSamples:
    """Sample the surfaces that each view sees, evenly over its sphere, as input of points.tracked."""
    samples = sample_surface(image.load(), image.load_mask(), range_map, **params.model_dump())
    ctx.metric("points", len(samples))
    return samples


class TrackedParams(Params):
    """Settings of points.tracked."""

    count: int = Field(default=100_000, ge=1, description="number of points of all views together")
    min_views: int = Field(default=2, ge=1, description="minimum number of views that see a point")
    neighbours: int = Field(default=16, ge=1, description="number of nearest views to test for each point")
    max_relative_error: float = Field(
        default=0.02, gt=0, description="maximum relative difference of ranges that agree"
    )
    min_confidence: int = Field(default=64, ge=1, le=255, description="minimum confidence of ranges that see a point")


@stage("points.tracked")
def tracked(
    poses: One[Poses], samples: All[SurfaceSamples], ranges: All[RangeMap], params: TrackedParams, ctx: Context
) -> TrackedPoints:
    """Select evenly distributed points with the views that see them: initial points for splats, tracks for COLMAP."""
    settings = params.model_dump() | {"min_views": min(params.min_views, len(samples))}
    usable = {name: samples[name] for name in samples if name in ranges}
    points = track_points(usable, poses, ranges.__getitem__, rng=ctx.rng, **settings)
    ctx.metric("points", len(points))
    ctx.metric("views_per_point", len(points.track_point_idx) / max(len(points), 1))
    if len(points) < params.count:
        ctx.note(
            f"{len(points)} {plural(len(points), 'point')} where {params.count} were asked for: the range maps "
            "have no more that are sure enough; raise points.surface's count or lower its "
            "min_confidence"
        )
    return points
