"""Pose solvers that run COLMAP, and a solver that extends a model with fixed cameras."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field, model_validator

from pano_mvs.algorithms.poses.colmap.sift import colmap_sift
from pano_mvs.algorithms.poses.colmap.solver import extend_with_colmap, solve_colmap
from pano_mvs.algorithms.poses.extension import extend_poses
from pano_mvs.api import (
    All,
    Context,
    Features,
    Panorama,
    Params,
    Poses,
    TwoView,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.stages.pose_paths import PosesPath
from pano_mvs.stages.poses import checked_poses, known_poses, reported_poses


@params_from(solve_colmap, own_last=True)
class ColmapParams(Params):
    """Settings of poses.colmap."""

    fixed: PosesPath | None = Field(
        default=None, description="known poses to keep fixed (any input of poses.from_model); incremental mapper only"
    )

    @model_validator(mode="after")
    def _fixed_needs_incremental(self) -> ColmapParams:
        if self.fixed is not None and arguments_from(solve_colmap, self)["mapper"] == "global":
            raise ValueError("COLMAP's global mapper moves all cameras: use mapper: incremental to keep some fixed")
        return self


@stage("poses.colmap")
def colmap_poses(features: All[Features], matches: All[TwoView], params: ColmapParams, ctx: Context) -> Poses:
    """Solve poses by COLMAP's incremental or global mapper, from our key points and verified matches."""
    return reported_poses(_mapped(features, matches, params, ctx=ctx), ctx)


@params_from(colmap_sift)
class ColmapSiftParams(ColmapParams):
    """Settings of poses.colmap_sift."""


@stage("poses.colmap_sift")
def colmap_sift_poses(images: All[Panorama], params: ColmapSiftParams, ctx: Context) -> Poses:
    """Solve poses by COLMAP alone: its planar SIFT, exhaustive matching, and mapper. Masks are respected."""
    pictures = ((name, image.load(), image.load_mask()) for name, image in images.items())
    features, matches = colmap_sift(pictures, **arguments_from(colmap_sift, params), rng=ctx.rng, scratch=ctx.scratch)
    return checked_poses(_mapped(features, matches, params, ctx=ctx), ctx)


@params_from(extend_poses)
class ExtendParams(Params):
    """Settings of poses.extend."""

    path: PosesPath = Field(description="known poses: any input of poses.from_model")


@stage("poses.extend")
def extend(features: All[Features], matches: All[TwoView], params: ExtendParams, ctx: Context) -> Poses:
    """Register new images with known cameras, whose poses stay exactly as they are; also gives sparse points."""
    known = known_poses(params.path, tuple(features))
    poses = extend_poses(known, features, matches, **arguments_from(extend_poses, params))
    return checked_poses(poses, ctx, remedy=f"{params.path} must contain poses of at least two images of the capture")


def _mapped(
    features: Mapping[str, Features], matches: Mapping[tuple[str, str], TwoView], params: ColmapParams, *, ctx: Context
) -> Poses:
    """Run COLMAP's mapper from scratch, or from fixed known poses."""
    if params.fixed is None:
        settings = arguments_from(solve_colmap, params)
        return solve_colmap(features, matches, **settings, rng=ctx.rng, scratch=ctx.scratch)
    known = known_poses(params.fixed, tuple(features))
    settings = arguments_from(extend_with_colmap, params)
    return extend_with_colmap(known, features, matches, **settings, rng=ctx.rng, scratch=ctx.scratch)
