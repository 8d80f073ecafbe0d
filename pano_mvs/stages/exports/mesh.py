"""Export of the scene's surface as a mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.mesh.atlas import unwrapped
from pano_mvs.algorithms.mesh.surface import (
    MIN_POINTS,
    Mesh,
    decimated,
    point_spacings,
    poisson_depth,
    solve_poisson,
    trimmed_mesh,
    without_crumbs,
)
from pano_mvs.algorithms.mesh.texture import TexturedMesh, balanced_views, textured
from pano_mvs.algorithms.mesh.view_quality import PaintView
from pano_mvs.algorithms.mesh.volume import (
    MAX_CELLS,
    NO_PLANES,
    Planes,
    empty_volume,
    most_certain,
    on_planes,
    plane_of_faces,
    seen_triangles,
)
from pano_mvs.api import All, Context, Files, InputError, One, Panorama, Params, PointCloud, Poses, RangeMap, stage
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3
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
from pano_mvs.io.point_selection import Selection, select_points
from pano_mvs.scene.files import group_file
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.surfaces import Structure
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


def solved_mesh(cloud: PointCloud, params: MeshParams, folder: Path) -> tuple[Mesh, int]:
    """Return the mesh of one group, and the depth of its octree.

    That is the depth of the settings, or one by point spacing.

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
    depth = params.depth or poisson_depth(points, spacing)
    solved = Mesh(*read_ply_mesh(solve_poisson(source, folder, depth=depth, point_weight=params.point_weight)))
    if params.trim:
        solved = trimmed_mesh(solved, points, max_spacings=params.trim)
    solved = without_crumbs(solved, smallest_share=params.smallest_part)
    if not len(solved.faces):
        raise InputError("the mesh has no faces: the points form no common surface. Raise `trim` or `max_points`")
    return solved, depth


NAME = "mesh_textured"


class TexturedParams(Params):
    """Settings of export.mesh_textured."""

    cell: float = Field(
        default=0.0,
        ge=0,
        description="width of the cells of the surface in scene units; 0: by the spacing of pixels. At most 8 million "
        "cells are used",
    )
    smallest_part: float = Field(
        default=0.001, ge=0, le=1, description="remove loose parts with less than this share of the triangles"
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
    # Measured: of each texel and of each pixel of a panorama while the texture is painted, and of each cell.
    painting = params.texture_px**2 * 60 + pixels * 120 + 400_000_000
    return max(MAX_CELLS * 85, painting)


@stage(
    "export.mesh_textured",
    memory=_memory,
    needs={"fast_simplification": "fast-simplification", "xatlas": "xatlas"},
)
def mesh_textured(
    ranges: All[RangeMap],
    measured: All[RangeMap] | None,
    planes: One[Structure] | None,
    poses: One[Poses],
    images: All[Panorama],
    params: TexturedParams,
    ctx: Context,
) -> Files:
    """Write the surface in the range maps with a texture from the panoramas, as mesh_textured.glb and .obj.

    The surface is the zero of the signed distances of all panoramas, weighted by their accuracy; where ranges of
    `measured` are confirmed and more accurate, they are used instead. It lies on the planes of `planes`, which continue
    where nobody looked. It is simplified and unwrapped. Each panorama gives its colours to the texels that it sees;
    masked pixels never do. Texels that no panorama sees are filled with the colours around them, and are black in
    mesh_textured_seen.png. Further groups of poses, each in its own frame, are mesh_textured_1.glb …
    """
    files: dict[str, Path] = {}

    def best(name: str) -> RangeMap:
        accurate = measured.get(name) if measured is not None else None
        return ranges[name] if accurate is None else most_certain(ranges[name], accurate)

    for number, own in enumerate(split_groups(poses)):
        folder = ctx.scratch / str(number)
        folder.mkdir()
        views = [
            MeshView(own.cam_from_world(idx), images[name], partial(best, name))
            for idx, name in enumerate(own.names)
            if name in images and name in ranges
        ]
        chosen = np.flatnonzero(planes.group_idx == number) if planes is not None else np.zeros(0, np.intp)
        found = (planes.normals_in_world[chosen], planes.offsets[chosen]) if planes is not None else NO_PLANES
        try:
            made = textured_mesh(views, found, params, ctx=ctx)
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


@dataclass(frozen=True, eq=False)
class MeshView:
    """A panorama, and a function that returns its ranges, so that those of all panoramas are not in memory at once."""

    cam_from_world: Rigid3
    image: Panorama
    range_map: Callable[[], RangeMap]

    def load(self) -> PaintView:
        """Return the panorama with its pixels."""
        range_map = self.range_map()
        fits = range_map.range.shape == self.image.size_hw
        return PaintView(self.cam_from_world, self.image.load(), self.image.load_mask(), range_map if fits else None)


def textured_mesh(views: Sequence[MeshView], planes: Planes, params: TexturedParams, *, ctx: Context) -> TexturedMesh:
    """Return the textured surface that one group of panoramas shows."""
    volume = empty_volume(((view.range_map(), view.cam_from_world) for view in views), cell=params.cell)
    for view in views:
        range_map = view.range_map()
        size = range_map.range.shape
        valid = view.image.load_mask() if view.image.size_hw == size else np.ones(size, np.bool_)
        volume.add(range_map, view.cam_from_world, valid, threads=ctx.threads)
    volume.carve()
    volume.continue_planes(planes)
    volume.close_gaps()
    vertices, faces = volume.surface()
    vertices, moved = on_planes((vertices, faces), planes, reach=0.75 * volume.cell)
    faces = seen_triangles((vertices, faces), [view.cam_from_world for view in views], moved, threads=ctx.threads)
    whole = Mesh(vertices, np.zeros(vertices.shape, np.uint8), faces)
    whole = without_crumbs(whole, smallest_share=params.smallest_part)
    if not len(whole.faces):
        raise InputError("the mesh has no faces: the range maps show no common surface. Check the poses and ranges")
    vertices, faces = decimated(whole.vertices_in_world, whole.faces, triangles=params.triangles)

    def load(idx: int) -> PaintView:
        return views[idx].load()

    balance = balanced_views(vertices, faces, load, views=len(views), threads=ctx.threads)
    if not balance.density > 0:
        raise InputError("no panorama sees the mesh, so it has no texture. Check the masks and the poses")
    region = plane_of_faces((vertices, faces), planes, tolerance=0.05 * volume.cell)
    density = balance.density * params.detail
    atlas = unwrapped(vertices, faces, texels_per_unit=density, max_px=params.texture_px, region=region)
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
