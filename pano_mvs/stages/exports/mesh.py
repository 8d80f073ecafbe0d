"""Export of the scene's surface as a mesh."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.mesh.atlas import unwrapped
from pano_mvs.algorithms.mesh.surface import (
    MIN_POINTS,
    FreeSpace,
    Mesh,
    decimated,
    point_spacings,
    poisson_depth,
    solve_poisson,
    trimmed_mesh,
    used_part,
    without_crumbs,
)
from pano_mvs.algorithms.mesh.texture import TexturedMesh, balanced_views, textured
from pano_mvs.algorithms.mesh.view_quality import PaintView
from pano_mvs.api import All, Context, Files, InputError, One, Panorama, Params, PointCloud, Poses, RangeMap, stage
from pano_mvs.core.text import plural
from pano_mvs.io.meshes import (
    SUFFIXES,
    TexturedArrays,
    TextureFormat,
    encoded_texture,
    write_glb,
    write_mtl,
    write_obj,
    write_usdz,
)
from pano_mvs.io.ply import read_ply, read_ply_mesh, write_ply, write_ply_mesh
from pano_mvs.io.thinning import Selection, select_points
from pano_mvs.scene.files import group_file
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import world_up, y_up_from_world
from pano_mvs.stages.exports.files import FrameParams, files_from_world


class MeshParams(FrameParams):
    """Settings of export.mesh."""

    depth: int = Field(
        default=0, ge=0, le=14, description="depth of the octree: cells are extent / 2^depth wide; 0: by point spacing"
    )
    point_weight: float = Field(default=1.0, ge=0, description="how closely the surface follows the points")
    trim: float = Field(
        default=4.0,
        ge=0,
        description="cut off parts farther from the points than this times their spacing; 0: keep all",
    )
    smallest_part: float = Field(
        default=0.001, ge=0, le=1, description="remove loose parts with less than this share of the triangles"
    )
    max_points: int = Field(
        default=500_000, ge=0, description="thin the cloud evenly to this number of points; 0: never"
    )
    min_views: int = Field(default=2, ge=0, le=255, description="minimum number of views that agree on a point")
    min_confidence: int = Field(default=64, ge=0, le=255, description="minimum confidence of a point")


@stage("export.mesh", memory="2GB")
def mesh(cloud: One[PointCloud], poses: One[Poses] | None, params: MeshParams, ctx: Context) -> Files:
    """Write the surface of the fused cloud as mesh.ply: coloured triangles from screened Poisson reconstruction, z up.

    The solver returns a closed surface; parts far from all points are cut off again. Triangles face the side that was
    seen. The solver uses one thread in any run, because the result would vary with more. Further groups of poses, each
    in its own frame, are mesh_1.ply, mesh_2.ply …
    """
    files, faces = {}, 0
    groups = cloud.groups()
    turns = files_from_world(params, poses, groups=len(groups))
    for number, group in enumerate(groups):
        folder = ctx.scratch / str(number)
        folder.mkdir()
        try:
            solved, depth = solved_mesh(group, params, folder)
        except InputError as error:
            if not number:
                raise
            ctx.note(f"no {group_file('mesh.ply', number)}: {error}")
            continue
        name = group_file("mesh.ply", number)
        files[name] = ctx.scratch / name
        arrays = (solved.vertices_in_world, solved.colors_rgb, solved.faces)
        write_ply_mesh(files[name], arrays, file_from_world=turns[number])
        faces += len(solved.faces)
        if not number:
            ctx.metric("depth", depth)
    ctx.metric("faces", faces)
    return Files(files)


def solved_mesh(cloud: PointCloud, params: MeshParams, folder: Path, *, deepest: int = 14) -> tuple[Mesh, int]:
    """Return the mesh of one group, and the depth of its octree.

    That is the depth of the settings, or one by point spacing, at most `deepest`.

    Raises:
        InputError: if too few points are left, or they have no common surface.
    """
    source = folder / "points.ply"
    selection = Selection(params.min_confidence, params.min_views, max_points=params.max_points)
    write_ply(source, cloud, kept=select_points(cloud, selection, folder))
    points = read_ply(source).points_in_world
    if len(points) < MIN_POINTS:
        raise InputError(
            f"{len(points)} of {len(cloud)} points {plural(len(points), 'is', 'are')} left for a mesh; {MIN_POINTS} "
            "are needed. Lower `min_views` or `min_confidence`, or find out why the cloud is empty"
        )
    spacing = float(np.median(point_spacings(points)))
    depth = params.depth or min(poisson_depth(points, spacing), deepest)
    solved = Mesh(*read_ply_mesh(solve_poisson(source, folder, depth=depth, point_weight=params.point_weight)))
    if params.trim:
        solved = trimmed_mesh(solved, points, max_spacings=params.trim)
    solved = without_crumbs(solved, smallest_share=params.smallest_part)
    if not len(solved.faces):
        raise InputError("the mesh has no faces: the points form no common surface. Raise `trim` or `max_points`")
    return solved, depth


NAME = "mesh_textured"


class TexturedParams(MeshParams):
    """Settings of export.mesh_textured."""

    depth: int = Field(
        default=0,
        ge=0,
        le=14,
        description="depth of the octree: cells are extent / 2^depth wide; 0: by point spacing, at most 9",
    )
    trim: float = Field(
        default=12.0,
        ge=0,
        description="cut off parts farther from the points than this times their spacing; 0: keep all",
    )
    triangles: int = Field(default=100_000, ge=100, description="number of triangles after simplification")
    texture_px: int = Field(default=4096, ge=64, le=16384, description="largest width and height of the texture")
    detail: float = Field(
        default=1.0, gt=0, le=4, description="texels per pixel of the panoramas, as they see most of the surface"
    )
    formats: tuple[Literal["glb", "obj", "usdz"], ...] = Field(
        default=("glb", "obj"), description="file formats of the mesh"
    )
    texture_format: TextureFormat = Field(default="jpeg", description="file format of the texture")
    jpeg_quality: int = Field(default=92, ge=1, le=100, description="quality of a JPEG texture")
    frame: Literal["upright", "world"] = Field(
        default="upright", description="upright: turned so that y points up, as glTF expects; world: as the poses"
    )


def _memory(params: Params, inputs: Mapping[str, Any]) -> int:
    assert isinstance(params, TexturedParams)
    images = inputs["images"]
    pixels = 0
    for name in images:
        height, width = images[name].size_hw
        pixels = max(pixels, height * width)
    # Measured: of each texel and of each pixel of a panorama while the texture is painted, of the mesh before it is
    # simplified, and of the solver.
    painting = params.texture_px**2 * 60 + pixels * 120 + 400_000_000
    return max(1_000_000_000, painting)


@stage(
    "export.mesh_textured",
    memory=_memory,
    needs={"fast_simplification": "fast-simplification", "xatlas": "xatlas"},
)
def mesh_textured(
    cloud: One[PointCloud],
    ranges: All[RangeMap],
    poses: One[Poses],
    images: All[Panorama],
    params: TexturedParams,
    ctx: Context,
) -> Files:
    """Write the surface of the fused cloud with a texture from the panoramas, as mesh_textured.glb and .obj.

    The surface of `export.mesh` is simplified and unwrapped. Each panorama gives its colours to the texels that it
    sees; masked pixels never do. Texels that no panorama sees are filled with the colours around them, and are black in
    mesh_textured_seen.png. Further groups of poses, each in its own frame, are mesh_textured_1.glb …
    """
    files: dict[str, Path] = {}
    for number, (group, own) in enumerate(zip(cloud.groups(), split_groups(poses), strict=False)):
        folder = ctx.scratch / str(number)
        folder.mkdir()
        try:
            made = textured_mesh(group, (own, images, ranges), params, folder=folder, ctx=ctx)
        except InputError as error:
            if not number:
                raise
            ctx.note(f"no {group_file(f'{NAME}.glb', number)}: {error}")
            continue
        rotation = y_up_from_world(world_up(own)) if params.frame == "upright" else np.eye(3)
        files |= _write(made, rotation, params, folder=folder, number=number)
        if not number:
            ctx.metric("triangles", len(made.faces))
            ctx.metric("texture_px", max(made.atlas.size_hw))
            corners = made.atlas.uv_px
            first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
            area = float(np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum()) / 2
            ctx.metric("seen", min(1.0, float(made.seen.sum()) / max(area, 1.0)))
    return Files(files)


def textured_mesh(
    cloud: PointCloud,
    views: tuple[Poses, Mapping[str, Panorama], Mapping[str, RangeMap]],
    params: TexturedParams,
    *,
    folder: Path,
    ctx: Context,
) -> TexturedMesh:
    """Return the textured surface of the cloud of one group of panoramas."""
    # Finer cells are noise: the mesh is simplified afterwards. They make many small charts, which take long to unwrap.
    solved, _ = solved_mesh(cloud, params, folder, deepest=9)
    poses, images, ranges = views
    names = [name for name in poses.names if name in images]

    def load(idx: int) -> PaintView:
        name = names[idx]
        image, range_map = images[name], ranges.get(name)
        if range_map is not None and range_map.range.shape != image.size_hw:
            range_map = None
        pose = poses.cam_from_world(poses.names.index(name))
        return PaintView(pose, image.load(), image.load_mask(), range_map)

    space = FreeSpace(solved.vertices_in_world)
    for name in names:
        if name in ranges:
            space.add(ranges[name], poses.cam_from_world(poses.names.index(name)), images[name].load_mask())
    free = space.free()
    solved = used_part(solved, solved.faces[~free[solved.faces].any(axis=1)])
    solved = without_crumbs(solved, smallest_share=params.smallest_part)
    if not len(solved.faces):
        raise InputError("the mesh has no faces: the panoramas look through all of them. Check the poses and ranges")
    vertices, faces = decimated(solved.vertices_in_world, solved.faces, triangles=params.triangles)

    balance = balanced_views(vertices, faces, load, views=len(names), threads=ctx.threads)
    if not balance.density > 0:
        raise InputError(
            "no panorama sees the mesh, so it has no texture. Check the masks and the poses, or lower `trim`"
        )
    atlas = unwrapped(vertices, faces, texels_per_unit=balance.density * params.detail, max_px=params.texture_px)
    return textured(vertices, faces, atlas, load=load, balance=balance, threads=ctx.threads)


def _write(
    mesh: TexturedMesh, rotation: NDArray[np.float64], params: TexturedParams, *, folder: Path, number: int
) -> dict[str, Path]:
    """Write the files of one group, and return them by target."""
    positions = (mesh.vertices_in_world[mesh.atlas.vertex] @ rotation.T).astype(np.float32)
    arrays = TexturedArrays(positions, mesh.atlas.uv, mesh.atlas.faces)
    picture = encoded_texture(mesh.texture, params.texture_format, quality=params.jpeg_quality)

    def target(suffix: str) -> str:
        return group_file(f"{NAME}{suffix}", number)

    seen = group_file(f"{NAME}.png", number).replace(".png", "_seen.png")
    files = {seen: folder / "seen.png"}
    write_png(files[seen], np.where(mesh.seen, np.uint8(255), np.uint8(0)))
    if "glb" in params.formats:
        files[target(".glb")] = folder / "mesh.glb"
        write_glb(files[target(".glb")], arrays, picture, form=params.texture_format)
    if "usdz" in params.formats:
        files[target(".usdz")] = folder / "mesh.usdz"
        write_usdz(files[target(".usdz")], arrays, picture, form=params.texture_format)
    if "obj" in params.formats:
        texture = target(SUFFIXES[params.texture_format])
        files |= {target(".obj"): folder / "mesh.obj", target(".mtl"): folder / "mesh.mtl", texture: folder / "texture"}
        write_obj(files[target(".obj")], arrays, material_file=target(".mtl"))
        write_mtl(files[target(".mtl")], texture_file=texture)
        files[texture].write_bytes(picture)
    return files
