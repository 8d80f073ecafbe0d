"""View selectors: which pictures each reference is swept against."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.views import select_views
from pano_mvs.api import Context, One, Params, Poses, Views, stage


class NearestParams(Params):
    """Settings of views.nearest."""

    sources: int = Field(default=4, ge=1, description="at most so many source pictures for each reference")


@stage("views.nearest")
def nearest(poses: One[Poses], params: NearestParams, ctx: Context) -> Views:
    """The pictures that see the same points from usefully different places, best first."""
    views = select_views(poses, count=params.sources)
    for name in poses.names:
        if name not in views.neighbours:
            ctx.reject(name, "no other picture was taken from another place near it")
    return views
