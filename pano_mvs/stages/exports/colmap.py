"""Exports in COLMAP's format: sparse models, dense workspaces, initial points for Gaussian splatting."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.faces.layout import Face, covers_sphere, default_face_size, panorama_faces
from pano_mvs.algorithms.faces.render import colmap_depth_view, face_source, render_face
from pano_mvs.api import (
    All,
    Context,
    Each,
    Files,
    Names,
    One,
    Panorama,
    Params,
    Poses,
    RangeMap,
    UsageError,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.core.paths import children
from pano_mvs.core.text import plural
from pano_mvs.geometry import PinholeView
from pano_mvs.io.colmap.workspace import (
    WORKSPACE,
    face_image_name,
    sparse_targets,
    write_face,
    write_picture,
    write_stereo_configs,
)
from pano_mvs.io.colmap.writer import CutPanorama, ModelForm, write_colmap_model, write_rig_model
from pano_mvs.scene.files import FaceFiles, item_stems
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.masking import nearest_pixels
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.surfaces import TrackedPoints
from pano_mvs.stages.exports.colmap_lenses import lens_rig_files


class ModelParams(Params):
    """Settings of export.colmap."""

    format: ModelForm = Field(default="bin", description="binary files, text files, or both (COLMAP prefers binary)")


@stage("export.colmap")
def colmap(
    poses: One[Poses],
    images: All[Panorama],
    photographs: One[Photographs] | None,
    params: ModelParams,
    ctx: Context,
) -> Files:
    """COLMAP model with EQUIRECTANGULAR cameras, points and tracks, in colmap/sparse/0.

    Further groups of poses, each in its own frame, are the models sparse/1, sparse/2 … Photographs that poses.localise
    has placed are in sparse/0, with SIMPLE_RADIAL cameras. For panoramas of source.dual_fisheye whose poses are in
    metres, colmap_rig/sparse/0 … are the same models with a rig of two OPENCV_FISHEYE cameras instead, whose pictures
    export.colmap_lenses writes.
    """
    if not poses.names:
        ctx.note("no model for COLMAP: no image is registered")
        return Files({})
    panoramic = _sparse_models(poses, images, params.format, photographs=photographs, ctx=ctx, target="colmap/sparse")
    return Files({**panoramic.files, **lens_rig_files(poses, images, params.format, ctx=ctx)})


class MasksParams(Params):
    """Settings of export.colmap_masks."""

    pictures: bool = Field(default=False, description="also export images, uncropped, for cropped input files")


@stage("export.colmap_masks")
def colmap_masks(image: Each[Panorama], params: MasksParams, ctx: Context) -> Files:
    """Write a mask for each panorama where COLMAP looks for it, colmap/masks/<image>.png: 0 is ignored, 255 is used.

    Masks have the size of the model's cameras. They are also written for panoramas without masked pixels, because
    COLMAP skips an image whose mask it does not find. With `pictures`, the panoramas themselves are
    colmap/images/<image>, in that size, uncropped, with masked pixels filled from their surroundings.
    """
    mask = image.load_mask()
    files = {"colmap/masks/{name}.png": ctx.scratch / "mask.png"}
    write_png(files["colmap/masks/{name}.png"], nearest_pixels(mask, image.source_size_hw).astype(np.uint8) * 255)
    if params.pictures:
        files["colmap/images/{name}"] = ctx.scratch / f"picture{image.image.path.suffix.lower()}"
        write_picture(files["colmap/images/{name}"], image.load(), image.source_size_hw)
    ctx.metric("masked_share", float((~mask).mean()))
    return Files(files)


@params_from(panorama_faces, own_last=True)
class FacesParams(Params):
    """Settings of export.colmap_faces."""

    min_confidence: int = Field(default=64, ge=1, le=255, description="minimum confidence of depths (64: seen)")
    image_format: Literal["jpg", "png"] = Field(
        default="jpg", description="format of the faces' images (JPEG: quality 95)"
    )


def faces_memory_bytes(params: FacesParams, inputs: Mapping[str, Any]) -> int:
    """Return the memory for the faces of one panorama: normals of the whole panorama, and one face at a time."""
    height, width = inputs["image"].size_hw
    cut = arguments_from(panorama_faces, params)
    size = cut["size_px"] or default_face_size((height, width), fov_deg=cut["fov_deg"])
    return int(200_000_000 + 70 * height * width + 60 * size**2)


@stage("export.colmap_faces", memory=faces_memory_bytes)
def colmap_faces(image: Each[Panorama], range_map: Each[RangeMap], params: FacesParams, ctx: Context) -> FaceFiles:
    """Write pinhole faces of each panorama for COLMAP's dense tools: images, masks, z-depth and normal maps.

    The files are in colmap_dense/; export.colmap_dense writes the model for them.
    """
    picture = image.load()
    source = face_source(
        picture, image.load_mask(), range_map, min_confidence=params.min_confidence, threads=ctx.threads
    )
    cut = arguments_from(panorama_faces, params)
    faces = panorama_faces(image.size_hw, **cut)
    if not covers_sphere(faces):
        ctx.note(
            f"{cut['layout']} faces of {cut['fov_deg']:g}° do not cover the sphere: some directions are in no face"
        )
    suffix, depths = f".{params.image_format}", []
    files: dict[str, Path] = {}
    for face in faces:
        seen = render_face(source, face.view, depth_view=colmap_depth_view(face.view), threads=ctx.threads)
        files |= write_face(
            ctx.scratch,
            face.name,
            suffix,
            image=seen.image,
            mask=seen.mask,
            z_depth=seen.z_depth,
            normals_in_face=seen.normals_in_face,
        )
        depths.append(np.isfinite(seen.z_depth).mean())
    ctx.metric("share_with_depth", float(np.mean(depths)))
    return FaceFiles(files, cut["layout"], cut["fov_deg"], faces[0].view.size_hw[0], suffix)


class DenseParams(Params):
    """Settings of export.colmap_dense."""

    format: ModelForm = Field(default="both", description="format of the model; some versions of OpenMVS need text")


@stage("export.colmap_dense")
def colmap_dense(
    poses: One[Poses],
    faces: All[FaceFiles],
    images: Names[Panorama],
    points: One[TrackedPoints] | None,
    params: DenseParams,
    ctx: Context,
) -> Files:
    """Write the model of export.colmap_faces: a dense workspace for COLMAP's fusion, OpenMVS and splat trainers.

    It contains a rig of PINHOLE cameras, a frame for each panorama and points with tracks, in colmap_dense/sparse and,
    for trainers, in sparse/0, and stereo/*.cfg. The points of points.tracked, if available, are added to the sparse
    ones, so that every face sees some. A workspace has one frame, that of the largest group of poses; models of other
    groups are in sparse/1, sparse/2 …
    """
    joined = poses if points is None else points.joined_to(poses, keep_points=True)
    largest, *others = split_groups(joined)
    cuts = _cuts(largest.names, faces, item_stems(images))
    if not cuts:
        raise UsageError("no panorama has both a pose and faces, so there is no workspace to write")
    folder = ctx.scratch / "sparse"
    seen = write_rig_model(folder, largest, cuts, form=params.format)
    files = sparse_targets(children(folder)) | write_stereo_configs(ctx.scratch, seen)
    for number, group in enumerate(others, start=1):
        files |= _other_model(group, number, _cuts(group.names, faces, item_stems(images)), form=params.format, ctx=ctx)
    _warn_about_spaces(seen, params.format, ctx)
    blind = sum(not count for count in seen.values())
    ctx.metric("faces_without_points", blind)
    if blind:
        ctx.note(
            f"{blind} of {len(seen)} faces {plural(blind, 'sees', 'see')} no point of the model: COLMAP fuses "
            f"none of {plural(blind, 'its', 'their')} depths. Add a stage points.tracked, or raise its "
            "count"
        )
    return Files(files)


class DenseInitParams(ModelParams):
    """Settings of export.colmap_dense_init."""

    keep_sfm: bool = Field(default=True, description="also include the sparse points of the pose solver")


@stage("export.colmap_dense_init")
def colmap_dense_init(
    poses: One[Poses], points: One[TrackedPoints], images: All[Panorama], params: DenseInitParams, ctx: Context
) -> Files:
    """COLMAP model with the dense points of points.tracked, in colmap_dense_init/sparse/0, to initialise splats.

    The cameras are the EQUIRECTANGULAR ones of export.colmap. Further groups of poses are in sparse/1, sparse/2 …
    """
    joined = points.joined_to(poses, keep_points=params.keep_sfm)
    ctx.metric("points", len(joined.points_in_world))
    return _sparse_models(joined, images, params.format, ctx=ctx, target="colmap_dense_init/sparse")


def _warn_about_spaces(names: Iterable[str], form: ModelForm, ctx: Context) -> None:
    found = next((name for name in names if " " in name), "") if form != "bin" else ""
    if found:
        ctx.note(
            f"{found!r} contains a space: in the text model, COLMAP and OpenMVS read the name only up to the space. "
            "Use the binary model, or rename the image"
        )


def _sparse_models(
    poses: Poses,
    images: Mapping[str, Panorama],
    form: ModelForm,
    *,
    photographs: Photographs | None = None,
    ctx: Context,
    target: str,
) -> Files:
    """Write a model for each group of poses into the folders 0, 1 … of the target."""
    files: dict[str, Path] = {}
    for number, group in enumerate(split_groups(poses)):
        folder = ctx.scratch / f"model_{number}"
        sizes_hw = {name: images[name].source_size_hw for name in group.names if name in images}
        write_colmap_model(folder, group, sizes_hw, photographs=photographs if number == 0 else None, form=form)
        files |= {f"{target}/{number}/{path.name}": path for path in children(folder)}
    _warn_about_spaces(poses.names, form, ctx)
    return Files(files)


def _other_model(
    group: Poses, number: int, cuts: Mapping[str, CutPanorama], *, form: ModelForm, ctx: Context
) -> dict[str, Path]:
    """Write the model of a group other than the workspace's, and return the targets of its files."""
    shown = ", ".join(group.names[:3]) + (f" … ({len(group.names)} images)" if len(group.names) > 3 else "")
    if not cuts:
        ctx.note(f"group {number} of the poses ({shown}) has no faces, so {WORKSPACE} contains no model of it")
        return {}
    folder = ctx.scratch / f"sparse_{number}"
    write_rig_model(folder, group, cuts, form=form)
    target = f"{WORKSPACE}/sparse/{number}"
    ctx.note(
        f"{WORKSPACE}/sparse is the model of the largest group of poses; group {number} ({shown}) has its own frame "
        f"and is in {target}. To fuse it, replace sparse by that model"
    )
    return {f"{target}/{path.name}": path for path in children(folder)}


def _cuts(names: Iterable[str], faces: Mapping[str, FaceFiles], stems: Mapping[str, str]) -> dict[str, CutPanorama]:
    """Return how each panorama with faces was cut; panoramas that were cut alike share their views."""
    shared: dict[tuple[str, float, int], tuple[Face, ...]] = {}
    views: dict[tuple[str, float, int], list[PinholeView]] = {}
    cuts: dict[str, CutPanorama] = {}
    for name in names:
        if name not in faces:
            continue
        cut = faces[name]
        way = cut.layout, cut.fov_deg, cut.size_px
        if way not in shared:
            shared[way] = panorama_faces((0, 0), layout=cut.layout, fov_deg=cut.fov_deg, size_px=cut.size_px)
            views[way] = [face.view for face in shared[way]]
        cuts[name] = CutPanorama(
            views[way], [face_image_name(face.name, stems[name], cut.suffix) for face in shared[way]]
        )
    return cuts
