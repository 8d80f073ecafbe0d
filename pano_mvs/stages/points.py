"""Points of the surfaces that range maps show, and in which images each is seen."""

from __future__ import annotations

from pano_mvs.algorithms.points.tracking import sample_surface, track_points
from pano_mvs.api import (
    All,
    Context,
    Each,
    One,
    Panorama,
    Params,
    Poses,
    RangeMap,
    arguments_from,
    stage,
)
from pano_mvs.scene.surfaces import SurfaceSamples, TrackedPoints


@stage("points.surface", settings=sample_surface)
def surface(image: Each[Panorama], range_map: Each[RangeMap], params: Params, ctx: Context) -> SurfaceSamples:
    """Sample the surfaces that each view sees, evenly over its sphere, as input of points.tracked."""
    samples = sample_surface(image.load(), image.load_mask(), range_map, **arguments_from(sample_surface, params))
    ctx.metric("points", len(samples))
    return samples


@stage("points.tracked", settings=track_points)
def tracked(
    poses: One[Poses], samples: All[SurfaceSamples], ranges: All[RangeMap], params: Params, ctx: Context
) -> TrackedPoints:
    """Select evenly distributed points with the views that see them: initial points for splats, tracks for COLMAP."""
    settings = arguments_from(track_points, params)
    settings["min_views"] = min(settings["min_views"], len(samples))
    usable = {name: samples[name] for name in samples if name in ranges}
    points = track_points(usable, poses, ranges.__getitem__, rng=ctx.rng, **settings)
    ctx.metric("points", len(points))
    ctx.metric("views_per_point", len(points.track_point_idx) / max(len(points), 1))
    if len(points) < settings["count"]:
        ctx.note(
            f"only {len(points)} of {settings['count']} points: the range maps contain no more reliable ones. Raise "
            "`count` of points.surface, or lower its `min_confidence`"
        )
    return points
