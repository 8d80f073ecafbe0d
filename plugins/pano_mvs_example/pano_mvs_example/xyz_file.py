"""The fused cloud as text."""

import numpy as np
from pano_mvs.api import Context, Files, One, Params, PointCloud, stage
from pydantic import Field


class XyzParams(Params):
    """Settings of export.xyz."""

    digits: int = Field(default=4, ge=0, le=9, description="behind the point of a coordinate")
    min_views: int = Field(default=1, ge=1, description="points on which fewer views agree are left out")


@stage("export.xyz")
def xyz(cloud: One[PointCloud], params: XyzParams, ctx: Context) -> Files:
    """The cloud as cloud.xyz: a line for each point, x y z red green blue."""
    kept = cloud.view_counts >= params.min_views
    ctx.metric("points", int(kept.sum()))
    rows = np.concatenate([cloud.points_in_world[kept], cloud.colors_rgb[kept]], axis=1)
    path = ctx.scratch / "cloud.xyz"
    np.savetxt(path, rows, fmt=[f"%.{params.digits}f"] * 3 + ["%d"] * 3)
    return Files({"cloud.xyz": path})
