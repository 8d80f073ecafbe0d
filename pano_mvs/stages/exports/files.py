"""Exports as point clouds, range maps and previews."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from pano_mvs.algorithms.fusion.view import normals_from_range
from pano_mvs.algorithms.points.octree import NODE_POINTS, octree
from pano_mvs.api import (
    All,
    Context,
    Each,
    Files,
    One,
    Panorama,
    Params,
    PointCloud,
    Poses,
    RangeMap,
    chunks,
    params_from,
    settings_from,
    stage,
)
from pano_mvs.io.images.preview import write_preview
from pano_mvs.io.ply import write_ply
from pano_mvs.io.point_selection import Selection, select_points
from pano_mvs.io.poses.metashape import write_metashape
from pano_mvs.io.poses.other_json import write_openmvg
from pano_mvs.io.ranges import (
    write_confidence_png,
    write_normals_png,
    write_normals_tiff,
    write_range_png,
    write_range_tiff,
)
from pano_mvs.io.tiles_3d import TilesetWriter
from pano_mvs.scene.exr import EXR_REMEDY, has_exr, write_exr
from pano_mvs.scene.files import group_file
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import world_up, z_up_from_world


class FrameParams(Params):
    """The frame of the coordinates in a file."""

    frame: Literal["upright", "world"] = Field(
        default="upright",
        description="upright: turned so that z points up; world: as the poses and COLMAP models, usually y down",
    )


def files_from_world(params: FrameParams, poses: Poses | None, *, groups: int) -> list[NDArray[np.float64] | None]:
    """Return the rotation (3, 3) into the axes of the file of each group; None for the world's own axes.

    Without poses, −y of the world is up.
    """
    if params.frame == "world":
        return [None] * groups
    if poses is None:
        return [z_up_from_world()] * groups
    known = [z_up_from_world(world_up(group)) for group in split_groups(poses)]
    return [known[number] if number < len(known) else z_up_from_world() for number in range(groups)]


class PosesParams(Params):
    """Settings of export.poses."""

    programs: tuple[Literal["openmvg", "metashape"], ...] = Field(
        default=("openmvg", "metashape"), description="programs whose files are written"
    )


@stage("export.poses")
def poses_files(poses: One[Poses], images: All[Panorama], params: PosesParams, ctx: Context) -> Files:
    """Write the poses as poses/sfm_data.json for openMVG, with points and tracks, and poses/cameras.xml for Metashape.

    Cameras are spherical and have the size of the image files. Both files have the world of the poses; the component in
    Metashape's file turns it so that z points up. Further groups of poses are sfm_data_1.json, cameras_1.xml …
    """
    files: dict[str, Path] = {}
    sizes_hw = {name: image.source_size_hw for name, image in images.items()}
    for number, group in enumerate(split_groups(poses)):
        if "openmvg" in params.programs:
            name = group_file("sfm_data.json", number)
            files[f"poses/{name}"] = ctx.scratch / name
            write_openmvg(ctx.scratch / name, group, sizes_hw)
        if "metashape" in params.programs:
            name = group_file("cameras.xml", number)
            files[f"poses/{name}"] = ctx.scratch / name
            turn = z_up_from_world(world_up(group))
            write_metashape(ctx.scratch / name, group, sizes_hw, file_from_world=turn)
    return Files(files)


@params_from(Selection)
class PlyParams(FrameParams):
    """Settings of export.ply."""

    quality: bool = Field(
        default=False, description="add the number of agreeing views and the confidence to each point"
    )
    uncertainty: bool = Field(
        default=False, description="add the standard deviation of each point, in scene units; NaN if unknown"
    )


@stage("export.ply")
def ply(cloud: One[PointCloud], poses: One[Poses] | None, params: PlyParams, ctx: Context) -> Files:
    """Write the fused cloud as cloud.ply: binary little endian, x y z nx ny nz red green blue, z up.

    The header states the rotation from the world of the poses. The cloud is thinned and written in chunks: memory does
    not grow with its size. Further groups of poses, each in its own frame, are cloud_1.ply, cloud_2.ply …; each file is
    thinned on its own.
    """
    selection = settings_from(Selection, params)
    groups = cloud.groups()
    files, points = {}, 0
    for number, (group, turn) in enumerate(
        zip(groups, files_from_world(params, poses, groups=len(groups)), strict=True)
    ):
        name = group_file("cloud.ply", number)
        kept = select_points(group, selection, ctx.scratch)
        files[name] = ctx.scratch / name
        extra = {"quality": params.quality, "uncertainty": params.uncertainty}
        write_ply(files[name], group, **extra, kept=kept, file_from_world=turn)
        points += len(group) if kept is None else kept.count
        if kept is not None and kept.voxel and not number:
            ctx.metric("voxel", kept.voxel)
    ctx.metric("points", points)
    return Files(files)


@params_from(Selection)
class Tiles3dParams(Params):
    """Settings of export.tiles_3d."""

    tile_points: int = Field(default=NODE_POINTS, ge=1000, description="largest number of points that a tile adds")


@stage("export.tiles_3d")
def tiles_3d(cloud: One[PointCloud], poses: One[Poses] | None, params: Tiles3dParams, ctx: Context) -> Files:
    """Write the fused cloud as tiles_3d/tileset.json for viewers of 3D Tiles 1.1: an octree of glTF files, z up.

    If GPS placed the cameras (`poses.scale` with `align: gps`), the tileset is at its place on the Earth. Further
    groups of poses are in tiles_3d_1/, tiles_3d_2/ …
    """
    selection = settings_from(Selection, params)
    groups = cloud.groups()
    own = [] if poses is None else split_groups(poses)
    files: dict[str, Path] = {}
    for number, group in enumerate(groups):
        folder = group_file("tiles_3d", number)
        (ctx.scratch / folder).mkdir()
        kept = select_points(group, selection, ctx.scratch)
        among = None
        if kept is not None:
            among = np.concatenate([part.start + np.flatnonzero(kept.within(part)) for part in chunks(len(group))])
        nodes = octree(group.points_in_world, among, node_points=params.tile_points)
        if not nodes:
            ctx.note(f"group {number} has no points that could be written")
            continue
        placed = own[number] if number < len(own) else None
        turn = z_up_from_world() if placed is None else z_up_from_world(world_up(placed))
        writer = TilesetWriter(ctx.scratch / folder, group, turn, tile_points=params.tile_points)
        for node in nodes:
            writer.add(node.name, node.chosen, node.size)
        metric = placed is not None and placed.metric
        about = {"unit": "metre" if metric else "scene unit", "file_from_world": turn.tolist()}
        writer.finish(about, None if placed is None else placed.origin_lla)
        files |= {f"{folder}/{name}": path for name, path in writer.files.items()}
        if not number:
            ctx.metric("tiles", len(nodes))
    return Files(files)


class RangesParams(Params):
    """Settings of export.ranges."""

    formats: tuple[Literal["tiff", "png", "exr", "npy"], ...] = Field(
        default=("tiff",), description="file formats: tiff, exr and npy are float32 with NaN as invalid; png is 16 bit"
    )
    png_unit: float = Field(default=0.001, gt=0, description="scene units per step of a 16-bit PNG; 0 is invalid")
    confidence: bool = Field(default=True, description="also write confidence/<image>.png")
    uncertainty: bool = Field(
        default=True, description="also write uncertainty/<image>.tiff: relative standard deviations, where known"
    )
    normals: tuple[Literal["tiff", "png", "exr", "npy"], ...] = Field(
        default=(), description="file formats of surface normals in the camera frame (x right, y down, z forward)"
    )

    @field_validator("formats", "normals")
    @classmethod
    def _can_be_written(cls, formats: tuple[str, ...]) -> tuple[str, ...]:
        if "exr" in formats and not has_exr():
            raise ValueError(EXR_REMEDY)
        return tuple(dict.fromkeys(formats))


@stage("export.ranges")
def ranges(range_map: Each[RangeMap], image: Each[Panorama] | None, params: RangesParams, ctx: Context) -> Files:
    """Write each range map as range/<image>.tiff (float32, NaN invalid) and confidence/<image>.png (8 bit, 0 invalid).

    If the uncertainty is known, uncertainty/<image>.tiff has the standard deviation divided by the range (float32).
    Other formats, and normals/<image>, are optional. The unit of a 16-bit PNG is in range/<image>.json.
    """
    valid = range_map.valid
    if image is not None:
        valid &= image.at_width(valid.shape[1]).load_mask()
    values = np.where(valid, range_map.range, np.float32(np.nan))
    files = {f"range/{{item}}.{name}": _write_range(values, name, params, ctx=ctx) for name in params.formats}
    if "png" in params.formats:
        files["range/{item}.json"] = ctx.scratch / "range.json"
    if params.confidence:
        files["confidence/{item}.png"] = ctx.scratch / "confidence.png"
        write_confidence_png(files["confidence/{item}.png"], np.where(valid, range_map.confidence, np.uint8(0)))
    if params.uncertainty and range_map.uncertainty is not None:
        files["uncertainty/{item}.tiff"] = ctx.scratch / "uncertainty.tiff"
        relative = np.where(valid, range_map.uncertainty, np.float16(np.nan)).astype(np.float32)
        write_range_tiff(files["uncertainty/{item}.tiff"], relative)
    if params.normals:
        given = range_map.normals_in_cam
        known = (
            normals_from_range(range_map, threads=ctx.threads)
            if given is None
            else np.asarray(given).astype(np.float32)
        )
        known = np.where(valid[..., None], known, np.float32(np.nan))
        files |= {f"normals/{{item}}.{name}": _write_normals(known, name, ctx.scratch) for name in params.normals}
    return Files(files)


@stage("export.previews")
def previews(range_map: Each[RangeMap], image: Each[Panorama], ctx: Context) -> Files:
    """Write a preview of each view, preview/<image>.jpg: the panorama beside its colour-mapped range with a scale bar.

    Masked pixels and pixels without a range are grey. Ranges that no other view confirms are pale, filled ones striped,
    and panes of mirrors and windows chequered.
    """
    path = ctx.scratch / "preview.jpg"
    write_preview(path, image.load(), range_map.range, mask=image.load_mask(), confidence=range_map.confidence)
    return Files({"preview/{item}.jpg": path})


def _write_range(values: NDArray[np.float32], suffix: str, params: RangesParams, *, ctx: Context) -> Path:
    path = ctx.scratch / f"range.{suffix}"
    if suffix == "tiff":
        write_range_tiff(path, values)
    elif suffix == "npy":
        np.save(path, values)
    elif suffix == "exr":
        write_exr(path, {"Z": values})
    else:
        beyond = write_range_png(path, values, unit=params.png_unit)
        ctx.metric("beyond_png", beyond / values.size)
        about = {"quantity": "range along the ray", "unit": params.png_unit, "invalid": 0, "beyond_px": beyond}
        (ctx.scratch / "range.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
    return path


def _write_normals(normals: NDArray[np.float32], suffix: str, folder: Path) -> Path:
    path = folder / f"normals.{suffix}"
    if suffix == "tiff":
        write_normals_tiff(path, normals)
    elif suffix == "png":
        write_normals_png(path, normals)
    elif suffix == "npy":
        np.save(path, normals)
    else:
        write_exr(path, {name: np.ascontiguousarray(normals[..., idx]) for idx, name in enumerate("RGB")})
    return path
