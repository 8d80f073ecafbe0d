"""The sources of each reference view."""

from __future__ import annotations

from pano_mvs.algorithms.views import select_views
from pano_mvs.api import (
    Context,
    One,
    Params,
    Poses,
    Views,
    arguments_from,
    stage,
)
from pano_mvs.scene.pose_groups import require_two_cameras

_PICTURE_BYTES, _RESULT_BYTES = 16, 40


@stage("views.nearest", settings=select_views)
def nearest(poses: One[Poses], params: Params, ctx: Context) -> Views:
    """Choose images that see the same points from sufficiently different positions, best first."""
    require_two_cameras(poses)
    views = select_views(poses, **arguments_from(select_views, params))
    for name in poses.names:
        if name not in views.neighbours:
            ctx.reject(name, "no other image was taken from a different position nearby")
    return views
