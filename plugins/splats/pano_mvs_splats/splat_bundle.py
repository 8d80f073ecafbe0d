"""One folder with everything that splat trainers read, and a manifest of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.faces.layout import default_face_size, panorama_faces
from pano_mvs.algorithms.faces.render import face_source
from pano_mvs.algorithms.undistortion import undistorted_photograph
from pano_mvs.api import (
    All,
    Context,
    Each,
    FilePart,
    Files,
    One,
    Panorama,
    PointCloud,
    Poses,
    RangeMap,
    arguments_from,
    stage,
)
from pano_mvs.core.paths import children
from pano_mvs.geometry import PinholeView
from pano_mvs.io.colmap.workspace import write_picture
from pano_mvs.io.colmap.writer import CutPanorama, write_colmap_model, write_rig_model
from pano_mvs.io.transforms_json import (
    ROOT,
    BundleView,
    NerfstudioFrame,
    PanoramaFrames,
    SplatFrames,
    manifest_document,
)
from pano_mvs.scene.files import group_file
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.pose_groups import split_groups, with_cameras
from pano_mvs.scene.surfaces import TrackedPoints
from pano_mvs_splats.transforms import (
    FrameFiles,
    FramesParams,
    Layers,
    PosedGroup,
    SeedParams,
    frames_with_poses,
    write_transforms,
)


def pinhole_photographs(photographs: Photographs, ctx: Context) -> Photographs:
    """Return photographs whose pictures have no distortion and are JPEGs; `.jpg` is added to their names.

    The pictures have no EXIF, so that no program turns them: the poses are those of the pictures as stored.
    """
    folder = ctx.scratch / "pinhole"
    folder.mkdir()
    pictures, focals_px = [], []
    for idx, file in enumerate(photographs.pictures):
        picture, focal_px = undistorted_photograph(
            decode_image(file.path, file.read_bytes()),
            focal_px=float(photographs.focals_px[idx]),
            radial=float(photographs.radials[idx]),
        )
        path = folder / f"{idx}.jpg"
        write_picture(path, picture)
        pictures.append(FilePart(path))
        focals_px.append(focal_px)
    return replace(
        photographs,
        names=tuple(f"{name}.jpg" for name in photographs.names),
        focals_px=np.array(focals_px),
        radials=np.zeros(len(photographs)),
        pictures=tuple(pictures),
    )


_PHOTOGRAPHS = "faces/transforms_photographs.json"


class SplatFramesParams(FramesParams):
    """Settings of export.splat_frames."""

    normals: bool = Field(default=True, description="also write normals")
    confidence: bool = Field(default=True, description="also write confidences")


def splat_frames_memory_bytes(params: SplatFramesParams, inputs: Mapping[str, Any]) -> int:
    """Return the memory for one panorama: its normals, its files as they are encoded, and one face at a time."""
    height, width = inputs["image"].size_hw
    cut = arguments_from(panorama_faces, params)
    size = cut["size_px"] or default_face_size((height, width), fov_deg=cut["fov_deg"])
    return int(200_000_000 + 100 * height * width + 80 * size**2)


@stage("export.splat_frames", memory=splat_frames_memory_bytes)
def splat_frames(
    image: Each[Panorama], range_map: Each[RangeMap], params: SplatFramesParams, ctx: Context
) -> SplatFrames:
    """Write images, masks, depths, normals and confidences of each panorama under splat_bundle/.

    export.splat_bundle lists them with poses. Depths are ranges along the ray for whole panoramas and z-depths for
    faces. Masked pixels have no depth; their colours are filled from their surroundings.
    """
    picture = image.load()
    source = face_source(
        picture, image.load_mask(), range_map, min_confidence=params.min_confidence, threads=ctx.threads
    )
    normals = np.where(np.isfinite(source.ranges)[..., None], source.normals_in_cam, np.float32(np.nan))
    layers = Layers(
        source.valid,
        source.ranges,
        normals if params.normals else None,
        source.confidence if params.confidence else None,
    )
    made = FrameFiles(ROOT, params, ctx)
    made.add(image, picture, layers)
    return SplatFrames(made.files, made.pictures, tuple(made.frames), params.depth_unit)


class SplatBundleParams(SeedParams):
    """Settings of export.splat_bundle."""

    photographs: bool = Field(
        default=True, description="also list the photographs of poses.localise, undistorted, beside the faces"
    )


@stage("export.splat_bundle")
def splat_bundle(
    frames: All[SplatFrames],
    poses: One[Poses],
    cloud: One[PointCloud] | None,
    points: One[TrackedPoints] | None,
    photographs: One[Photographs] | None,
    params: SplatBundleParams,
    ctx: Context,
) -> Files:
    """Write the frames of export.splat_frames as a dataset for splat trainers: splat_bundle/ with manifest.json.

    Each variant is a folder that is complete in itself: transforms.json for nerfstudio, a COLMAP model in sparse/0 for
    gsplat and others, and seed.ply. The points of points.tracked, if available, are added to the model. Further groups
    of poses are transforms_1.json, seed_1.ply and sparse/1 … Photographs that poses.localise has placed are written
    without distortion into the folder of the faces, and listed in its model and in transforms_photographs.json.
    """
    loaded = frames_with_poses(poses, frames, ctx)
    joined = poses if points is None else points.joined_to(poses, keep_points=True)
    files: dict[str, Path] = {}
    about: list[dict[str, Any]] = []
    views: list[BundleView] = []
    shown = photographs if params.photographs else None
    taken = None if shown is None else _taken(shown, loaded, ctx)
    groups = PosedGroup.all_of(poses, loaded, cloud, photographs=taken)
    for group, with_points in zip(groups, split_groups(joined), strict=True):
        written: dict[str, Path] = {}
        if group.frames:
            written = write_transforms(ROOT, group, params, ctx=ctx) | _write_models(group, with_points, ctx=ctx)
            views += _views(group)
        about.append(_about(group.number, group.poses, written))
        files |= written
    unit = next(iter(loaded.values())).depth_unit
    document = manifest_document(views, about, depth_unit=unit, photographs=taken)
    files[f"{ROOT}/manifest.json"] = ctx.scratch / "manifest.json"
    files[f"{ROOT}/manifest.json"].write_text(json.dumps(document, indent=1), encoding="utf-8")
    ctx.metric("views", len(views))
    return Files(files)


def _taken(photographs: Photographs, frames: Mapping[str, PanoramaFrames], ctx: Context) -> Photographs | None:
    """Return the photographs as they are listed beside the faces; None if there are none, or no faces."""
    if not len(photographs):
        return None
    if not any(frame.variant == "faces" for each in frames.values() for frame in each.frames):
        ctx.note("photographs are only listed beside faces: add faces to the variants of export.splat_frames")
        return None
    ctx.metric("photographs", len(photographs))
    return pinhole_photographs(photographs, ctx)


def _views(group: PosedGroup) -> list[BundleView]:
    poses = group.poses.cameras
    return [
        BundleView(name, group.number, frame, frame.cam_from_world(poses[name]))
        for listed in group.listed().values()
        for name, frame in listed
    ]


def _about(number: int, poses: Poses, written: Mapping[str, Path]) -> dict[str, Any]:
    """Return what the manifest states about a group: its world, and the files that list its images."""
    variants: dict[str, dict[str, str]] = {}
    names = {"transforms": group_file("transforms.json", number), "seeds": group_file("seed.ply", number)}
    for variant in ("equirectangular", "faces"):
        places = {key: f"{variant}/{name}" for key, name in names.items() if f"{ROOT}/{variant}/{name}" in written}
        if places:
            variants[variant] = places | {"colmap": f"{variant}/sparse/{number}"}
    if f"{ROOT}/{_PHOTOGRAPHS}" in written:
        variants["faces"]["photographs"] = _PHOTOGRAPHS
    return {
        "number": number,
        "metric": poses.metric,
        "scene_unit": "metre" if poses.metric else poses.scale,
        "world": poses.frame,
        "variants": variants,
    }


def _write_models(group: PosedGroup, poses: Poses, *, ctx: Context) -> dict[str, Path]:
    """Write a COLMAP model of each variant, whose image names are relative to the folder images/ of the variant."""
    files: dict[str, Path] = {}
    for variant, listed in group.listed().items():
        folder = ctx.scratch / f"{variant}_{group.number}"
        if variant == "faces":
            write_rig_model(folder, poses, _cuts(listed), photographs=group.photographs, form="bin")
        else:
            frames = dict(listed)
            kept = with_cameras(poses, np.array([name in frames for name in poses.names]))
            names = tuple(_image_name(name, frames[name]) for name in kept.names)
            sizes = {image: frames[name].size_wh[::-1] for image, name in zip(names, kept.names, strict=True)}
            write_colmap_model(folder, replace(kept, names=names, evidence={}, doubts={}), sizes, form="bin")
        target = f"{ROOT}/{variant}/sparse/{group.number}"
        files |= {f"{target}/{path.name}": path for path in children(folder)}
    return files


def _cuts(listed: Sequence[tuple[str, NerfstudioFrame]]) -> dict[str, CutPanorama]:
    """Return the faces of each panorama; panoramas that were cut alike share their views, and so a rig."""
    faces: dict[str, list[NerfstudioFrame]] = {}
    for name, frame in listed:
        faces.setdefault(name, []).append(frame)
    shared: dict[Any, list[PinholeView]] = {}
    cuts = {}
    for name, own in faces.items():
        layout = tuple((frame.frame_from_cam, frame.focal_xy, frame.size_wh) for frame in own)
        views = shared.setdefault(layout, [_pinhole(frame) for frame in own])
        cuts[name] = CutPanorama(views, [_image_name(name, frame) for frame in own])
    return cuts


def _pinhole(frame: NerfstudioFrame) -> PinholeView:
    width, height = frame.size_wh
    center = np.array([width / 2, height / 2])
    return PinholeView(np.array(frame.frame_from_cam), frame.focal_xy[0], center, (height, width))


def _image_name(panorama: str, frame: NerfstudioFrame) -> str:
    return frame.image.removeprefix("images/").replace("{name}", panorama)
