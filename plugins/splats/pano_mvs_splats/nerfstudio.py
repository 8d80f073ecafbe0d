"""Exports for nerfstudio: panoramas, or pinhole faces of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.algorithms.faces.layout import panorama_faces
from pano_mvs.api import All, Context, Each, Files, One, Panorama, PointCloud, Poses, RangeMap, arguments_from, stage
from pano_mvs.io.transforms_json import NerfstudioFrames
from pano_mvs.scene.photographs import Photographs
from pano_mvs.stages.exports.files import FrameParams, files_from_world
from pano_mvs_splats.transforms import (
    FrameFiles,
    FramesParams,
    Layers,
    PosedGroup,
    SeedParams,
    frames_with_poses,
    write_transforms,
)

_ROOT = "nerfstudio"


class NerfstudioFramesParams(FramesParams):
    """Settings of export.nerfstudio_frames."""


def frames_memory_bytes(params: NerfstudioFramesParams, inputs: Mapping[str, Any]) -> int:
    """Return the memory for one panorama: 40 bytes a pixel, measured at 4096 and 8192 columns, and one face."""
    height, width = inputs["image"].size_hw
    return int(40 * (height * width + (arguments_from(panorama_faces, params)["size_px"] or 0) ** 2))


@stage("export.nerfstudio_frames", memory=frames_memory_bytes)
def nerfstudio_frames(
    image: Each[Panorama], range_map: Each[RangeMap] | None, params: NerfstudioFramesParams, ctx: Context
) -> NerfstudioFrames:
    """Write images, masks and depths of each panorama under nerfstudio/, for export.nerfstudio.

    Masked pixels have no depth; their colours are filled from their surroundings, for programs that ignore masks. A
    panorama without masked pixels that is a colour JPEG (not CMYK) or an 8-bit PNG of the working resolution is copied
    unchanged.
    """
    valid = image.load_mask()
    ranges = None
    if range_map is not None:
        kept = valid & range_map.valid & (range_map.confidence >= params.min_confidence)
        ranges = np.where(kept, range_map.range, np.float32(np.nan))
    made = FrameFiles(_ROOT, params, ctx)
    made.add(image, image.load(), Layers(valid, ranges))
    return NerfstudioFrames(made.files, made.pictures, tuple(made.frames), params.depth_unit)


class NerfstudioParams(FrameParams, SeedParams):
    """Settings of export.nerfstudio."""


@stage("export.nerfstudio")
def nerfstudio(
    frames: All[NerfstudioFrames],
    poses: One[Poses],
    cloud: One[PointCloud] | None,
    photographs: One[Photographs] | None,
    params: NerfstudioParams,
    ctx: Context,
) -> Files:
    """Write the frames of export.nerfstudio_frames as nerfstudio/<variant>/transforms.json, with initial points.

    Cameras and points are turned so that z points up; `file_from_world` states the rotation from the world of the poses
    and of COLMAP models. Without a cloud, the sparse points of the poses are used. A file has one frame: further groups
    of poses are transforms_1.json with seed_1.ply, transforms_2.json … Photographs that poses.localise has placed are
    listed after the faces in faces/transforms_photographs.json, each with its own focal length and distortion.
    """
    loaded = frames_with_poses(poses, frames, ctx)
    files: dict[str, Path] = {}
    groups = PosedGroup.all_of(poses, loaded, cloud, photographs=photographs)
    for group in groups:
        if group.frames:
            (turn,) = files_from_world(params, group.poses, groups=1)
            files |= write_transforms(_ROOT, group, params, ctx=ctx, file_from_world=turn)
    if len(groups) > 1:
        ctx.note(
            f"the poses are in {len(groups)} groups, each in its own frame: transforms.json lists the largest group, "
            "transforms_1.json … the others"
        )
    return Files(files)
