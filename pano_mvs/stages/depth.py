"""Sweeps: the range of every pixel of a reference from its neighbours."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.sweep.hypotheses import range_limits
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, stage


class SweepParams(Params):
    """Settings of depth.sweep."""

    backend: Literal["numba", "numpy"] = Field(default="numba", description="numpy is the slow, readable reference")
    planes: int = Field(default=128, ge=3, le=4096, description="number of virtual ranges")
    spacing: Literal["inverse", "log", "uniform"] = Field(
        default="inverse", description="virtual ranges: even in 1/range, log range, or range (the paper)"
    )
    near: float | None = Field(
        default=None, gt=0, description="nearest virtual range, scene units; else from the sparse points or baselines"
    )
    far: float | None = Field(default=None, gt=0, description="farthest virtual range, likewise")
    cost: Literal["census", "sad"] = Field(
        default="census", description="census, or the paper's sum of absolute differences"
    )
    window: int = Field(default=7, ge=1, le=15, description="side of the cost's window in pixels, odd")
    spherical_window: bool = Field(
        default=True, description="widen windows towards the poles so that they keep their solid angle"
    )
    combination: Literal["sum", "best_half"] = Field(
        default="best_half", description="over sources: all (the paper), or the better half, which copes with occlusion"
    )
    aggregation: Literal["box", "sgm"] = Field(
        default="sgm", description="winner takes all after a box (the paper), or semi-global matching"
    )
    support: int = Field(
        default=5, ge=1, le=15, description="side of the box over which census costs are averaged, odd"
    )
    p1: int = Field(default=80, ge=0, le=5000, description="SGM's penalty of a step by one plane, for 512 rows")
    p2: int = Field(default=1600, ge=0, le=7900, description="SGM's penalty of a larger step, for 512 rows")
    p2_contrast: float = Field(
        default=15.0, ge=0, description="grey levels of contrast at which p2 is halved; 0 keeps it"
    )
    subplane: bool = Field(default=True, description="parabola between the planes")
    prefilter_diameter: int = Field(
        default=0,
        ge=0,
        le=31,
        description="bilateral filter of the pictures before the sweep (the paper: 3); 0 is none",
    )
    prefilter_sigma_color: float = Field(default=25.0, gt=0, description="its width in grey levels")
    prefilter_sigma_space_px: float = Field(default=25.0, gt=0, description="its width in pixels")
    exposure: bool = Field(default=True, description="match the exposure of sources to the reference's")


_NOT_SETTINGS = {"backend", "near", "far"}


@stage("depth.sweep")
def sweep(
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    params: SweepParams,
    ctx: Context,
) -> RangeMap:
    """The sphere sweep over virtual ranges: for each the sources are looked up where the reference's rays would end.

    Without `near` and `far` the limits come from the sparse points that the reference sees, else from its baselines.
    """
    source_from_reference = [other.cam_from_world @ pose.cam_from_world.inverse() for other in source_poses]
    baselines = [float(np.linalg.norm(transform.translation)) for transform in source_from_reference]
    near, far = range_limits(baselines, width=ref.size_hw[1], near=pose.near, far=pose.far)
    range_map = sweep_range(
        ref.load(),
        [source.load() for source in sources],
        source_from_reference,
        near=params.near or near,
        far=params.far or far,
        settings=SweepSettings(**params.model_dump(exclude=_NOT_SETTINGS)),
        backend=params.backend,
        reference_mask=ref.load_mask(),
        source_masks=[source.load_mask() for source in sources],
    )
    ctx.metric("completeness", float(range_map.valid.mean()))
    ctx.metric("sources", len(sources))
    return range_map
