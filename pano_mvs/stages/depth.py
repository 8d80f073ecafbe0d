"""Sweeps: the range of every pixel of a reference from its neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pano_mvs.algorithms.sweep.backends.registry import SWEEP_BACKENDS, backend_for, check_levels
from pano_mvs.algorithms.sweep.costs.registry import SWEEP_COSTS
from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.api import NOT_IN_KEY, Context, Each, Near, Panorama, Params, PartOf, Pose, RangeMap, stage
from pano_mvs.core.errors import UsageError
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.stages.fields import Odd

_NOT_SETTINGS = {"backend", "device", "near", "far"}


class SweepParams(Params):
    """Settings of depth.sweep."""

    backend: Annotated[str, PartOf(SWEEP_BACKENDS)] = Field(
        default="numba", description="numpy is the slow, readable reference; opencv; a plugin's"
    )
    device: Annotated[str, NOT_IN_KEY] = Field(
        default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$", description="where a backend that can choose computes"
    )
    planes: int = Field(default=128, ge=3, le=4096, description="number of virtual ranges")
    spacing: Literal["inverse", "log", "uniform"] = Field(
        default="inverse", description="virtual ranges: even in 1/range, log range, or range (the paper)"
    )
    near: float | None = Field(
        default=None, gt=0, description="nearest virtual range, scene units; else found by small sweeps"
    )
    far: float | None = Field(default=None, gt=0, description="farthest virtual range, likewise")
    cost: Annotated[str, PartOf(SWEEP_COSTS)] = Field(
        default="census",
        description="census, census_gradient (with grey levels and their gradients), zncc (correlation), sad (the "
        "paper's sum of absolute differences), sad_gradient (colours with their gradients), or a plugin's",
    )
    window: Odd = Field(default=7, ge=1, le=15, description="side of the cost's window in pixels, odd")
    spherical_window: bool = Field(
        default=True, description="widen windows towards the poles so that they keep their solid angle"
    )
    combination: Literal["sum", "best_half", "best_k", "parallax_weighted"] = Field(
        default="best_half",
        description="over sources: all (the paper), the better half or the best few, which copes with occlusion, or "
        "the better half by the parallax that each of them sees",
    )
    best: int = Field(default=2, ge=1, description="how many sources best_k takes")
    aggregation: Literal["box", "sgm"] = Field(
        default="sgm", description="winner takes all after a box (the paper), or semi-global matching"
    )
    support: Odd = Field(
        default=5, ge=1, le=15, description="side of the box over which census costs, and plugins', are averaged, odd"
    )
    p1: int = Field(default=80, ge=0, le=4000, description="SGM's penalty of a step by one plane, for 512 rows")
    p2: int = Field(default=1600, ge=0, le=4000, description="SGM's penalty of a larger step, for 512 rows")
    p2_contrast: float = Field(
        default=15.0, ge=0, description="grey levels of contrast at which p2 is halved; 0 keeps it"
    )
    selection: Literal["winner", "parabola", "vfit"] = Field(
        default="vfit", description="the cheapest plane (the paper), or the minimum of a parabola or a V around it"
    )
    confidence: Literal["peak_ratio", "curvature", "combined"] = Field(
        default="peak_ratio", description="how much dearer the best rival is, how sharp the minimum is, or both"
    )
    no_match: Literal["invalid", "keep"] = Field(
        default="invalid",
        description="bare pixels that run to the nearest or farthest plane, and all (the sky) that run to a farthest "
        "plane as good as infinitely far: leave `far` to be found outdoors; the paper keeps them",
    )
    prefilter_diameter: int = Field(
        default=0,
        ge=0,
        le=31,
        description="bilateral filter of the pictures before the sweep (the paper: 3); 0 is none",
    )
    prefilter_sigma_color: float = Field(default=25.0, gt=0, description="its width in grey levels")
    prefilter_sigma_space_px: float = Field(default=25.0, gt=0, description="its width in pixels")
    derotate: bool = Field(
        default=False, description="resample each source to the reference's orientation first (the paper)"
    )
    exposure: bool = Field(
        default=True, description="match the exposure of sources to the reference's where colours are compared"
    )
    levels: int = Field(
        default=1,
        ge=1,
        le=4,
        description="1: every plane everywhere; 2 or 3: a sweep at half or a quarter of the resolution says where to "
        "look, which is faster",
    )
    volume_limit_gb: float = Field(
        default=4.0,
        gt=0,
        description="memory (10⁹ bytes) of semi-global matching; larger panoramas are matched in parts that overlap",
    )

    @model_validator(mode="after")
    def _fit_together(self) -> SweepParams:
        backend_for(self.backend, self.cost)
        check_levels(self.backend, self.levels)
        SweepSettings(**self.model_dump(exclude=_NOT_SETTINGS))
        if self.near is not None and self.far is not None and not self.near < self.far:
            raise UsageError(f"near must be less than far, got {self.near} and {self.far}")
        return self


# Bytes a pixel and plane of semi-global matching: costs and sums, 1 and 2; torch keeps paths, numpy 64 bits of all.
_VOLUME_BYTES = {"torch": 8, "numpy": 24}
_PICTURE_BYTES, _RESULT_BYTES = 16, 40


def sweep_memory_bytes(params: SweepParams, inputs: Mapping[str, Any]) -> int:
    """Return what a sweep takes at its most: the volume of semi-global matching, pictures as they are packed, winners.

    From coarse to fine the volume is that of the coarsest level; numba's is limited by a setting.
    """
    panoramas: list[Panorama] = [inputs["ref"], *inputs["sources"]]
    pixels, *others = (panorama.size_hw[0] * panorama.size_hw[1] for panorama in panoramas)
    volume = pixels * params.planes * _VOLUME_BYTES.get(params.backend, 3) if params.aggregation == "sgm" else 0
    pictures = _PICTURE_BYTES * (pixels + sum(others))
    volume >>= 2 * (params.levels - 1)
    if params.backend == "numba":
        volume = min(volume, int(params.volume_limit_gb * 1e9))
    return volume + pictures + _RESULT_BYTES * pixels


@stage("depth.sweep", memory=sweep_memory_bytes)
def sweep(
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    params: SweepParams,
    ctx: Context,
) -> RangeMap:
    """The sphere sweep over virtual ranges: for each the sources are looked up where the reference's rays would end.

    Without `near` and `far` the limits come from small sweeps of the reference and its first sources, from what they
    agree on.
    """
    require_one_group(pose, source_poses)
    pictures = [ref.load(), *(source.load() for source in sources)]
    masks = [ref.load_mask(), *(source.load_mask() for source in sources)]
    poses = [pose.cam_from_world, *(other.cam_from_world for other in source_poses)]
    near, far = params.near, params.far
    if near is None or far is None:
        found = limits_by_sweeping(pictures, poses, masks=masks, backend=params.backend, device=params.device)
        near, far = near or found[0], far or found[1]
    range_map = sweep_range(
        pictures[0],
        pictures[1:],
        [other @ poses[0].inverse() for other in poses[1:]],
        near=near,
        far=far,
        settings=SweepSettings(**params.model_dump(exclude=_NOT_SETTINGS)),
        backend=params.backend,
        device=params.device,
        reference_mask=masks[0],
        source_masks=masks[1:],
    )
    ctx.metric("completeness", float(range_map.valid.mean()))
    ctx.metric("sources", len(sources))
    ctx.metric("near", near)
    ctx.metric("far", far)
    return range_map
