"""Pose solvers that run COLMAP."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pano_mvs.algorithms.poses.colmap import solve_colmap
from pano_mvs.api import All, Context, Features, Params, Poses, TwoView, stage
from pano_mvs.stages.poses import checked_poses


class ColmapParams(Params):
    """Settings of poses.colmap."""

    mapper: Literal["incremental", "global"] = Field(default="incremental", description="COLMAP's mapper")
    cameras: Literal["sphere", "faces"] = Field(
        default="sphere", description="EQUIRECTANGULAR cameras, or a rig of six pinhole faces for each panorama"
    )


@stage("poses.colmap")
def colmap_poses(features: All[Features], matches: All[TwoView], params: ColmapParams, ctx: Context) -> Poses:
    """COLMAP's incremental or global mapper, seeded with our key points and verified matches; one pose a panorama."""
    poses = solve_colmap(
        features, matches, mapper=params.mapper, cameras=params.cameras, rng=ctx.rng, scratch=ctx.scratch
    )
    return checked_poses(poses, ctx)
