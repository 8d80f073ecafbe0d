"""View selectors: choose the source images against which each reference is swept."""

from __future__ import annotations

from pano_mvs.algorithms.views import select_views
from pano_mvs.api import Context, One, Params, Poses, Views, arguments_from, params_from, stage


@params_from(select_views)
class NearestParams(Params):
    """Settings of views.nearest."""


@stage("views.nearest")
def nearest(poses: One[Poses], params: NearestParams, ctx: Context) -> Views:
    """Choose images that see the same points from sufficiently different positions, best first."""
    views = select_views(poses, **arguments_from(select_views, params))
    for name in poses.names:
        if name not in views.neighbours:
            ctx.reject(name, "no other image was taken from a different position nearby")
    return views
