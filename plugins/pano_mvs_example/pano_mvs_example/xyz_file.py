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
    """The cloud as cloud.xyz: a line for each point, x y z in the world frame, red green blue.

    Points of panoramas that nothing connects with the others have a frame of their own, and so a file: cloud_1.xyz …
    """
    files, points = {}, 0
    for number, group in enumerate(cloud.groups()):
        kept = group.view_counts >= params.min_views
        points += int(kept.sum())
        rows = np.concatenate([group.points_in_world[kept], group.colors_rgb[kept]], axis=1)
        name = f"cloud_{number}.xyz" if number else "cloud.xyz"
        files[name] = ctx.scratch / name
        np.savetxt(files[name], rows, fmt=[f"%.{params.digits}f"] * 3 + ["%d"] * 3)
    ctx.metric("points", points)
    return Files(files)
