"""View selectors: choose the source images against which each reference is swept."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.views import select_views
from pano_mvs.api import Context, One, Params, Poses, Views, stage


class NearestParams(Params):
    """Settings of views.nearest."""

    sources: int = Field(default=4, ge=1, description="maximum number of source images per reference")


@stage("views.nearest")
def nearest(poses: One[Poses], params: NearestParams, ctx: Context) -> Views:
    """Choose images that see the same points from sufficiently different positions, best first."""
    views = select_views(poses, count=params.sources)
    for name in poses.names:
        if name not in views.neighbours:
            ctx.reject(name, "no other image was taken from a different position nearby")
    return views
