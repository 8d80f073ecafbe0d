"""Export of the scene's surface as a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.mesh.surface import (
    MIN_POINTS,
    Mesh,
    point_spacings,
    poisson_depth,
    solve_poisson,
    trimmed_mesh,
    without_crumbs,
)
from pano_mvs.api import Context, Files, InputError, One, PointCloud, Poses, stage
from pano_mvs.core.text import plural
from pano_mvs.io.clouds.mesh_writer import read_ply_mesh, write_ply_mesh
from pano_mvs.io.clouds.ply_writer import read_ply, write_ply
from pano_mvs.io.clouds.thinning import Selection, select_points
from pano_mvs.scene.files import group_file
from pano_mvs.stages.exports.axes import FrameParams, files_from_world


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
