"""Exports for nerfstudio: panoramas, or pinhole faces of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.faces.layout import panorama_faces
from pano_mvs.algorithms.faces.pictures import face_image, face_mask
from pano_mvs.algorithms.faces.ranges import face_z_depth
from pano_mvs.api import (
    All,
    Context,
    Each,
    FilePart,
    Files,
    InputError,
    One,
    Panorama,
    Params,
    PointCloud,
    Poses,
    RangeMap,
    arguments_from,
    params_from,
    stage,
    write_png,
)
from pano_mvs.core.text import plural
from pano_mvs.io.clouds.ply_writer import write_ply
from pano_mvs.io.clouds.thinning import Selection, select_points
from pano_mvs.io.colmap.image_copies import write_picture
from pano_mvs.io.nerfstudio.frames import NerfstudioFrame, NerfstudioFrames, Variant
from pano_mvs.io.nerfstudio.transforms import is_common_picture, open_mask, transforms_document
from pano_mvs.io.ranges.files import write_range_png
from pano_mvs.scene.files import group_file
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.stages.exports.axes import FrameParams, files_from_world

_NO_TURN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_MUCH = 0.01


@params_from(panorama_faces)
class _CutParams(Params):
    """How panoramas are cut into faces."""

    variants: tuple[Variant, ...] = Field(
        default=("equirectangular", "faces"), min_length=1, description="whole panoramas, pinhole faces, or both"
    )


class NerfstudioFramesParams(_CutParams):
    """Settings of export.nerfstudio_frames."""

    image_format: Literal["jpg", "png"] = Field(
        default="jpg", description="format of images that are not copied unchanged"
    )
    depth_unit: float = Field(
        default=0.001, gt=0, description="scene units per step of the 16-bit depths; pass other values to nerfstudio"
    )
    min_confidence: int = Field(default=64, ge=0, le=255, description="minimum confidence of depths")


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
    made = _FrameFiles(params, ctx)
    if "equirectangular" in params.variants:
        _add_panorama(made, image, valid, ranges=ranges)
    if "faces" in params.variants:
        _add_faces(made, image, valid, ranges=ranges)
    share = made.beyond / made.depths if made.depths else 0.0
    ctx.metric("beyond_depth", share)
    if share > _MUCH:
        ctx.note(
            f"some depths exceed the {65535 * params.depth_unit:g} scene units that 16 bits hold in steps of "
            f"{params.depth_unit:g}, and are left out; use a larger depth_unit to include them"
        )
    return NerfstudioFrames(made.files, made.pictures, tuple(made.frames), params.depth_unit)


class NerfstudioParams(FrameParams):
    """Settings of export.nerfstudio."""

    seed_points: int = Field(
        default=500_000, ge=0, description="initial points for splats, thinned evenly from the cloud; 0: none"
    )
    min_views: int = Field(
        default=2, ge=0, le=255, description="minimum number of views that agree on an initial point"
    )


@stage("export.nerfstudio")
def nerfstudio(
    frames: All[NerfstudioFrames],
    poses: One[Poses],
    cloud: One[PointCloud] | None,
    params: NerfstudioParams,
    ctx: Context,
) -> Files:
    """Write the frames of export.nerfstudio_frames as nerfstudio/<variant>/transforms.json, with initial points.

    Cameras and points are turned so that z points up; `file_from_world` states the rotation from the world of the poses
    and of COLMAP models. Without a cloud, the sparse points of the poses are used. A file has one frame: further groups
    of poses are transforms_1.json with seed_1.ply, transforms_2.json …
    """
    loaded = {name: frames[name] for name in poses.names if name in frames}
    if not loaded:
        raise InputError("no panorama has both a pose and frames: nothing can be listed in transforms.json")
    if len(loaded) < len(poses.names):
        without = len(poses.names) - len(loaded)
        ctx.note(
            f"{without} of {len(poses.names)} registered panoramas {plural(without, 'has', 'have')} no ranges and "
            f"{plural(without, 'is', 'are')} not in transforms.json"
        )
    files: dict[str, Path] = {}
    groups = split_groups(poses)
    clouds = [] if cloud is None else cloud.groups()
    for number, group in enumerate(groups):
        own = clouds[number] if number < len(clouds) else None
        files |= _write_group(number, group, loaded, cloud=own, params=params, ctx=ctx)
    if len(groups) > 1:
        ctx.note(
            f"the poses are in {len(groups)} groups, each in its own frame: transforms.json lists the largest group, "
            "transforms_1.json … the others"
        )
    return Files(files)


def _write_group(
    number: int,
    poses: Poses,
    frames: Mapping[str, NerfstudioFrames],
    *,
    cloud: PointCloud | None,
    params: NerfstudioParams,
    ctx: Context,
) -> dict[str, Path]:
    """Write the transforms and the initial points of one group of poses, and return the targets of the files."""
    registered = {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names) if name in frames}
    loaded = {name: frames[name] for name in registered}
    if not loaded:
        return {}
    files: dict[str, Path] = {}
    scratch = ctx.scratch / str(number)
    scratch.mkdir()
    (turn,) = files_from_world(params, poses, groups=1)
    seed = _write_seed(poses, cloud, params, turn=turn, ctx=ctx, scratch=scratch)
    about = {"scene_unit": "metre" if poses.metric else poses.scale, "world_frame": poses.frame}
    if turn is not None:
        about["file_from_world"] = turn.tolist()
    seed_name, transforms = group_file("seed.ply", number), group_file("transforms.json", number)
    for variant in sorted({frame.variant for each in loaded.values() for frame in each.frames}):
        listed = [
            (name, registered[name], frame)
            for name, each in loaded.items()
            for frame in each.frames
            if frame.variant == variant
        ]
        document = transforms_document(
            variant,
            listed,
            depth_unit=next(iter(loaded.values())).depth_unit,
            about=about,
            file_from_world=turn,
            seed="" if seed is None else seed_name,
        )
        folder = f"nerfstudio/{variant}"
        path = files[f"{folder}/{transforms}"] = scratch / f"{variant}.json"
        path.write_text(json.dumps(document, indent=1), encoding="utf-8")
        if seed is not None:
            files[f"{folder}/{seed_name}"] = seed
        files |= _open_masks(listed, folder, scratch)
        ctx.metric(variant, ctx.metrics.get(variant, 0) + len(listed))
    return files


class _FrameFiles:
    """The files of one panorama."""

    def __init__(self, params: NerfstudioFramesParams, ctx: Context) -> None:
        self.params = params
        self.scratch = ctx.scratch
        self.threads = ctx.threads
        self.files: dict[str, Path] = {}
        self.pictures: dict[str, FilePart] = {}
        self.frames: list[NerfstudioFrame] = []
        self.beyond = 0
        self.depths = 0

    def write(self, target: str, suffix: str) -> Path:
        """Return the path at which to write the file for a target."""
        path = self.files[target] = self.scratch / f"{len(self.files)}{suffix}"
        return path

    def add_mask(self, folder: str, name: str, valid: NDArray[np.bool_]) -> str:
        """Write a mask unless nothing is masked; return its path relative to transforms.json."""
        if valid.all():
            return ""
        write_png(self.write(f"{folder}/masks/{name}.png", ".png"), np.where(valid, np.uint8(255), np.uint8(0)))
        return f"masks/{name}.png"

    def add_depth(self, folder: str, name: str, depths: NDArray[np.float32] | None) -> str:
        """Write depths, if there are any; return their path relative to transforms.json."""
        if depths is None:
            return ""
        self.depths += int(np.isfinite(depths).sum())
        target = self.write(f"{folder}/depths/{name}.png", ".png")
        self.beyond += write_range_png(target, depths, unit=self.params.depth_unit)
        return f"depths/{name}.png"


def _add_panorama(
    made: _FrameFiles, image: Panorama, valid: NDArray[np.bool_], *, ranges: NDArray[np.float32] | None
) -> None:
    folder, name = "nerfstudio/equirectangular", "{name}"
    height, width = image.size_hw
    whole = image.crop_ltwh is None and image.size_hw == image.source_size_hw
    if whole and valid.all() and is_common_picture(image.image.path):
        picture = f"images/{name}"
        made.pictures[f"{folder}/{picture}"] = image.image
    else:
        picture = f"images/{name}.{made.params.image_format}"
        write_picture(made.write(f"{folder}/{picture}", f".{made.params.image_format}"), image.load())
    mask, depth = made.add_mask(folder, name, valid), made.add_depth(folder, name, ranges)
    made.frames.append(
        NerfstudioFrame("equirectangular", picture, mask, depth, (width, height), (width / 2, float(height)), _NO_TURN)
    )


def _add_faces(
    made: _FrameFiles, image: Panorama, valid: NDArray[np.bool_], *, ranges: NDArray[np.float32] | None
) -> None:
    folder, params = "nerfstudio/faces", made.params
    panorama = image.load()
    for face in panorama_faces(image.size_hw, **arguments_from(panorama_faces, params)):
        view, name = face.view, f"{{name}}.{face.name}"
        picture = f"images/{name}.{params.image_format}"
        write_picture(made.write(f"{folder}/{picture}", f".{params.image_format}"), face_image(panorama, view))
        seen = face_mask(valid, view)
        depths = None
        if ranges is not None:
            depths = np.where(seen, face_z_depth(ranges, view, threads=made.threads), np.float32(np.nan))
        mask, depth = made.add_mask(folder, name, seen), made.add_depth(folder, name, depths)
        turn = tuple(tuple(map(float, row)) for row in view.view_from_cam)
        size, focal = (view.size_hw[1], view.size_hw[0]), (view.focal_px, view.focal_px)
        made.frames.append(NerfstudioFrame("faces", picture, mask, depth, size, focal, turn))


def _write_seed(
    poses: Poses,
    cloud: PointCloud | None,
    params: NerfstudioParams,
    *,
    turn: NDArray[np.float64] | None,
    ctx: Context,
    scratch: Path,
) -> Path | None:
    """Write the initial points; return None if there are none."""
    if cloud is None or not len(cloud):
        count = len(poses.points_in_world)
        cloud = PointCloud(
            poses.points_in_world.astype(np.float32),
            np.zeros((count, 3), np.float32),
            poses.point_colors_rgb,
            np.full(count, 255, np.uint8),
        )
    if not params.seed_points or not len(cloud):
        return None
    selection = Selection(min_views=params.min_views, max_points=params.seed_points)
    kept = select_points(cloud, selection, scratch)
    ctx.metric("seed_points", ctx.metrics.get("seed_points", 0) + (len(cloud) if kept is None else kept.count))
    path = scratch / "seed.ply"
    write_ply(path, cloud, kept=kept, file_from_world=turn)
    return path


def _open_masks(listed: Sequence[tuple[str, object, NerfstudioFrame]], folder: str, scratch: Path) -> dict[str, Path]:
    """Write masks of frames without masked pixels if other frames have masks: nerfstudio needs one for each frame."""
    if not any(frame.mask for _, _, frame in listed):
        return {}
    files = {}
    for width, height in {frame.size_wh for _, _, frame in listed if not frame.mask}:
        path = files[f"{folder}/{open_mask((width, height))}"] = scratch / f"open_{width}x{height}.png"
        write_png(path, np.full((height, width), 255, np.uint8))
    return files
