"""Ranges at the size of the image files, which may be larger than that of the dense stages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.patchmatch.full_size import (
    STRIP_ROWS,
    enlarged_strips,
    joined_strips,
    refine_in_strips,
    sources_in_grey,
    widths_between,
)
from pano_mvs.algorithms.patchmatch.refine import WindowSettings, refine_range
from pano_mvs.algorithms.scales import sharp_halvings
from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, arguments_from, params_from, stage
from pano_mvs.core.arrays import Picture
from pano_mvs.io.growing_arrays import GrowingArrays
from pano_mvs.scene.pose_groups import require_one_group

# Bytes: of a pixel of a strip for each source and beside; of a pixel of the largest size for each source; of the
# reference, and of decoding a picture.
_STRIP_SOURCE_BYTES, _STRIP_BYTES, _GREY_BYTES, _REFERENCE_BYTES = 8, 130, 2, 9


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
    strip = width * (STRIP_ROWS + 64) * (_STRIP_BYTES + _STRIP_SOURCE_BYTES * sources)
    return width * width // 2 * (_GREY_BYTES * sources + _REFERENCE_BYTES) + strip


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
