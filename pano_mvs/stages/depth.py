"""Sweeps and their refinement: the range of every pixel of a reference from its neighbours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from pano_mvs.algorithms.patchmatch.exchange import SourceView, exchange_ranges
from pano_mvs.algorithms.patchmatch.full_size import (
    STRIP_ROWS,
    enlarged_strips,
    joined_strips,
    refine_in_strips,
    sources_in_grey,
    widths_between,
)
from pano_mvs.algorithms.patchmatch.refine import WindowSettings, refine_at_scale, refine_plain_surfaces, refine_range
from pano_mvs.algorithms.scales import coarser_levels, enlarged_range_map, ranges_of_levels, reduced, sharp_halvings
from pano_mvs.algorithms.structure.floors import floors_of_groups
from pano_mvs.algorithms.sweep.backends.registry import SWEEP_BACKENDS, backend_for
from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.preparation import planes_before
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.api import (
    NOT_IN_KEY,
    All,
    Context,
    Each,
    Near,
    One,
    Panorama,
    Params,
    Pose,
    Poses,
    RangeMap,
    RegisteredIn,
    arguments_from,
    params_from,
    settings_from,
    stage,
)
from pano_mvs.core.arrays import Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.io.growing_arrays import GrowingArrays
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.scene.surfaces import Structure
from pano_mvs.stages.filters import bytes_per_pixel

_PICTURE_BYTES, _RESULT_BYTES = 16, 40


@params_from(SweepSettings)
class SweepParams(Params):
    """Settings of depth.sweep."""

    backend: Annotated[str, RegisteredIn(SWEEP_BACKENDS)] = Field(
        default="numba", description="numba, opencv, numpy (slow reference), or that of a plugin"
    )
    device: Annotated[str, NOT_IN_KEY] = Field(
        default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$", description="device, for backends that have a choice"
    )
    near: float | None = Field(
        default=None, gt=0, description="nearest depth hypothesis, scene units; null: estimated by small sweeps"
    )
    far: float | None = Field(default=None, gt=0, description="farthest depth hypothesis; null: estimated")

    scale: Literal["finer", "sharp", "nominal"] = Field(
        default="finer",
        description="resolution of the sweep: up to twice that at which the panorama is sharp, that one, or its own",
    )
    multiscale: bool = Field(
        default=True,
        description="sweep panoramas of 2048 columns and more also at half the resolution, down to 1024 columns, for "
        "what shows only noise at the full one; not with scale: nominal",
    )

    @model_validator(mode="after")
    def _fit_together(self) -> SweepParams:
        backend_for(self.backend, settings_from(SweepSettings, self))
        if self.near is not None and self.far is not None and not self.near < self.far:
            raise UsageError(f"near must be less than far, got {self.near} and {self.far}")
        return self


def sweep_memory_bytes(params: SweepParams, inputs: Mapping[str, Any]) -> int:
    """Return the most that a sweep takes: the volume of semi-global matching, the packed pictures, the winners."""
    panoramas: list[Panorama] = [inputs["ref"], *inputs["sources"]]
    pixels, *others = (panorama.size_hw[0] * panorama.size_hw[1] for panorama in panoramas)
    volume = SWEEP_BACKENDS.get(params.backend).volume_bytes(pixels, settings_from(SweepSettings, params))
    return volume + _PICTURE_BYTES * (pixels + sum(others)) + _RESULT_BYTES * pixels


@stage("depth.sweep", memory=sweep_memory_bytes)
def sweep(
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    known: One[Structure] | None,
    params: SweepParams,
    ctx: Context,
) -> RangeMap:
    """Sphere sweep: select, for each pixel of the reference, the depth hypothesis at which the sources match best.

    Without `near` and `far`, the limits are estimated from small sweeps of the reference and its first sources that
    must agree with each other. A blurred panorama is swept at up to twice the resolution at which it is sharp, where
    edges are still better than at that one. With the floors of depth.floors, windows on these are matched too, and
    ranges below them count less, by the backend numba with semi-global matching.
    """
    require_one_group(pose, source_poses)
    pictures = [ref.load(), *(source.load() for source in sources)]
    masks = [ref.load_mask(), *(source.load_mask() for source in sources)]
    poses = [pose.cam_from_world, *(other.cam_from_world for other in source_poses)]
    near, far = params.near, params.far
    if near is None or far is None:
        limits = limits_by_sweeping(pictures, poses, masks=masks, backend=params.backend, device=params.device)
        near, far = near or limits[0], far or limits[1]
    halvings = sharp_halvings(pictures[0]) if params.scale != "nominal" else 0
    if params.scale == "finer":
        halvings = max(halvings - 1, 0)
    pictures, masks = reduced(pictures, masks, halvings=halvings)

    def swept(halvings: int) -> RangeMap:
        small, valid = reduced(pictures, masks, halvings=halvings)
        return sweep_range(
            small[0],
            small[1:],
            [other @ poses[0].inverse() for other in poses[1:]],
            near=near,
            far=far,
            settings=settings_from(SweepSettings, params),
            backend=params.backend,
            device=params.device,
            reference_mask=valid[0],
            source_masks=valid[1:],
            planes=None if known is None else planes_before(known, poses[0], pose.group),
        )

    levels = coarser_levels(pictures[0].shape[:2]) if params.multiscale and params.scale != "nominal" else 0
    found = ranges_of_levels(levels, lambda level: reduced(pictures[:1], [], halvings=level)[0][0], swept)
    range_map = enlarged_range_map(found, ref.size_hw)
    ctx.metric("completeness", float(range_map.valid.mean()))
    ctx.metric("sources", len(sources))
    ctx.metric("near", near)
    ctx.metric("far", far)
    return range_map


@stage("depth.floors")
def known_floors(poses: One[Poses], images: All[Panorama], ctx: Context) -> Structure:
    """Find floors before the sweep, in small sweeps of all views.

    Only those are kept below which views see less than on them. Use it after poses.level: without known gravity, no
    plane is level.
    """
    found = floors_of_groups(poses, images, rng=ctx.rng)
    ctx.metric("planes", len(found))
    return found


@params_from(refine_range)
class PatchMatchParams(Params):
    """Settings of depth.patchmatch."""

    scale: Literal["sharp", "nominal"] = Field(
        default="sharp", description="where to begin: the resolution at which the panorama is sharp, or its own"
    )
    multiscale: bool = Field(
        default=True,
        description="refine panoramas of 2048 columns and more also at half the resolution, down to 1024 columns, for "
        "what shows only noise at the full one; not with scale: nominal",
    )


@stage("depth.patchmatch", memory=bytes_per_pixel(140, each_source=20))
def patchmatch(
    range_map: Each[RangeMap],
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    params: PatchMatchParams,
    ctx: Context,
) -> RangeMap:
    """Fit slanted planes to the ranges and move them to where the images match best; also gives normals."""
    require_one_group(pose, source_poses)
    reference = ref.load()
    is_nominal = params.scale == "nominal"
    refined = refine_at_scale(
        range_map,
        reference,
        [source.load() for source in sources],
        source_from_reference=[other.cam_from_world @ pose.cam_from_world.inverse() for other in source_poses],
        source_masks=[source.load_mask() for source in sources],
        halvings=0 if is_nominal else sharp_halvings(reference),
        levels=coarser_levels(ref.size_hw) if params.multiscale and not is_nominal else 0,
        **arguments_from(refine_range, params),
    )
    ctx.metric("completeness", float(refined.valid.mean()))
    ctx.metric("sources", len(sources))
    return refined


@stage("depth.plain_surfaces", memory=bytes_per_pixel(150, each_source=20))
def plain_surfaces(
    range_map: Each[RangeMap],
    filtered: Each[RangeMap],
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    params: PatchMatchParams,
    ctx: Context,
) -> RangeMap:
    """Refine pixels without texture again where filters changed their ranges; all other pixels keep theirs.

    `range_map` comes from depth.patchmatch, `filtered` from a consistency check and filters after it.
    """
    require_one_group(pose, source_poses)
    reference = ref.load()
    refined, share = refine_plain_surfaces(
        range_map,
        filtered,
        reference,
        sources=[source.load() for source in sources],
        source_from_reference=[other.cam_from_world @ pose.cam_from_world.inverse() for other in source_poses],
        source_masks=[source.load_mask() for source in sources],
        halvings=sharp_halvings(reference) if params.scale == "sharp" else 0,
        **arguments_from(refine_range, params),
    )
    ctx.metric("completeness", float(refined.valid.mean()))
    ctx.metric("refined", share)
    ctx.metric("sources", len(sources))
    return refined


@stage("depth.exchange", settings=exchange_ranges, memory=bytes_per_pixel(205, each_source=40))
def exchange(
    range_map: Each[RangeMap],
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_images: Near[Panorama],
    source_poses: Near[Pose],
    params: Params,
    ctx: Context,
) -> RangeMap:
    """Give unconfirmed pixels the nearer ranges that other views found, where the images match better.

    Follow it with filters.consistency that compares with the ranges before the exchange (`in: {sources: ...}`):
    otherwise, exchanged ranges confirm each other.
    """
    require_one_group(pose, source_poses)
    views = [
        SourceView(image.load(), source, other.cam_from_world @ pose.cam_from_world.inverse(), image.load_mask())
        for source, image, other in zip(sources, source_images, source_poses, strict=True)
    ]
    exchanged, share = exchange_ranges(range_map, ref.load(), views, **arguments_from(exchange_ranges, params))
    ctx.metric("exchanged", share)
    ctx.metric("sources", len(sources))
    return exchanged


@params_from(refine_range)
class FullSizeParams(Params):
    """Settings of depth.full_size."""

    max_width: int = Field(default=16384, ge=16, description="largest width of the range maps, at most the file's")
    max_sources: int = Field(default=4, ge=1, description="sources, the best ones, that are compared at these sizes")
    rounds: int = Field(default=2, ge=0, le=32, description="rounds of fitting and matching planes at each size")


def full_size_memory_bytes(params: FullSizeParams, inputs: Mapping[str, Any]) -> int:
    """Return the memory for the grey levels of the sources, the reference, a strip, and the result of half the size."""
    width: int = inputs["ref"].at_width(params.max_width).size_hw[1]
    sources = min(len(inputs["sources"]), params.max_sources)
    # Bytes: of a pixel of a strip for each source and beside; of a pixel of the largest size for each source; of the
    # reference, and of decoding a picture.
    strip = width * (STRIP_ROWS + 64) * (130 + 8 * sources)
    return width * width // 2 * (2 * sources + 9) + strip


@stage("depth.full_size", memory=full_size_memory_bytes)
def full_size(
    range_map: Each[RangeMap],
    ref: Each[Panorama],
    pose: Each[Pose],
    sources: Near[Panorama],
    source_poses: Near[Pose],
    params: FullSizeParams,
    ctx: Context,
) -> RangeMap:
    """Enlarge ranges to the size of the image file, and refine them there by slanted planes.

    Pixels keep their confidences. Those without detail at a size, and those that were filled, are interpolated. A range
    map that has the size of the file is returned unchanged.
    """
    widths = widths_between(range_map.range.shape[1], ref.at_width(params.max_width).size_hw[1])
    if not widths:
        return range_map
    require_one_group(pose, source_poses)
    near = list(sources)[: params.max_sources]
    poses = [other.cam_from_world @ pose.cam_from_world.inverse() for other in list(source_poses)[: params.max_sources]]
    settings = arguments_from(refine_range, params)
    windows = {name: settings[name] for name in WindowSettings.__dataclass_fields__}
    for width in widths:
        size_hw = ref.at_width(width).size_hw
        if params.rounds == 0 or sharp_halvings(_painted(ref.at_width(width), ref)) > 0:  # half the size shows as much
            strips = enlarged_strips(range_map, size_hw)
        else:
            there = [source.at_width(width) for source in near]
            # Decoding takes twice the memory of a picture, so the reference is decoded again after the sources.
            grey = sources_in_grey(
                ((source.load_unmasked(), source.load_mask()) for source in there),
                sizes_hw=[source.size_hw for source in there],
                source_from_reference=poses,
                settings=WindowSettings(**windows),
            )
            strips = refine_in_strips(
                range_map,
                _painted(ref.at_width(width), ref),
                grey,
                source_from_reference=poses,
                rounds=params.rounds,
                view_weights=settings["view_weights"],
                **windows,
            )
            del grey
        range_map = joined_strips(strips) if width < widths[-1] else _in_files(strips, ctx.scratch)
        del strips  # large
    ctx.metric("completeness", float(range_map.valid.mean()))
    ctx.metric("width", widths[-1])
    ctx.metric("sources", len(near))
    return range_map


def _painted(large: Panorama, small: Panorama) -> Picture:
    """Return a picture whose masked pixels have the colours of a smaller one, in which they are painted over."""
    picture, valid = large.load_unmasked(), large.load_mask()
    if valid.all():
        return picture
    painted = small.load()
    rows = np.flatnonzero(~valid.all(axis=1))
    for row in rows:
        below = row * painted.shape[0] // picture.shape[0]
        columns = np.flatnonzero(~valid[row])
        picture[row, columns] = painted[below, columns * painted.shape[1] // picture.shape[1]]
    return picture


def _in_files(strips: Iterable[RangeMap], folder: Path) -> RangeMap:
    """Return one range map of all strips, whose arrays are memory-mapped files in a folder."""
    with GrowingArrays(folder) as grown:
        for strip in strips:
            grown.append({name: getattr(strip, name) for name in ("range", "confidence", "uncertainty", "sky")})
        return RangeMap(**grown.arrays())
