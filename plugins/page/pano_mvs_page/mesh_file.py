"""The surface that a run exported: a textured mesh as binary glTF 2.0 (GLB), or a mesh with coloured vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.io.meshes import read_glb
from pano_mvs.io.ply import read_ply_mesh
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene.files import group_file
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import WORLD_UP, world_up, y_up_from_world

TEXTURED = "mesh_textured.glb"
COLORED = "mesh.ply"


@dataclass(frozen=True, eq=False)
class SharedMesh:
    """Triangles with a texture, or else with coloured vertices."""

    vertices: NDArray[np.float32]  # (V, 3) float32
    faces: NDArray[np.int32]  # (F, 3) int32, anticlockwise as seen from the side that was seen
    colors_rgb: NDArray[np.uint8] | None = None  # (V, 3) uint8; None with a texture
    # (V, 2) float32 places in the texture, from its lower-left corner; None without a texture
    uv: NDArray[np.float32] | None = None
    texture: NDArray[np.uint8] | None = None  # (H, W, 3) uint8 RGB; None without a texture

    def moved(self, target_from_source: Rigid3 | Similarity3) -> SharedMesh:
        """Return the mesh in another frame."""
        return replace(self, vertices=target_from_source.apply(self.vertices).astype(np.float32))


def run_mesh(run: RunOutput, group: int = 0) -> tuple[SharedMesh | None, str]:
    """Return the mesh of a group of a run in its world frame, and a note; the textured one if there are two.

    Files that an earlier run left behind are not used.

    Returns:
        The mesh, or None if there is none or it cannot be read; and what the reader of the page should know, or "".
    """
    notes = []
    for textured, name in ((True, group_file(TEXTURED, group)), (False, group_file(COLORED, group))):
        if not run.has_file(name):
            continue
        try:
            mesh = _textured(run, name, group) if textured else _colored(run, name)
        except InputError as error:
            notes.append(str(error))
            continue
        if not np.isfinite(mesh.vertices).all():
            notes.append(f"{run.out / name}: was left out: some of its corners are not finite numbers. Export it again")
        elif len(mesh.faces):
            return mesh, "; ".join(notes)
    return None, "; ".join(notes)


def thinned(mesh: SharedMesh, max_faces: int) -> tuple[SharedMesh, str]:
    """Return a mesh with coloured vertices with at most about `max_faces` triangles, and a note.

    A textured mesh is returned as it is, because the places in its texture would be lost; `export.mesh_textured`
    thins the mesh before it is unwrapped.
    """
    if mesh.texture is not None or max_faces >= len(mesh.faces):
        return mesh, ""
    import fast_simplification  # type: ignore[import-untyped, unused-ignore]
    from scipy.spatial import cKDTree

    vertices, faces = fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=max_faces)
    nearest = cKDTree(mesh.vertices).query(vertices)[1]
    colors = mesh.colors_rgb[nearest] if mesh.colors_rgb is not None else None
    return SharedMesh(vertices.astype(np.float32), faces.astype(np.int32), colors), ""


def coarser(mesh: SharedMesh, max_faces: int) -> SharedMesh | None:
    """Return a mesh with coloured vertices and about `max_faces` triangles; None if the mesh itself is as small."""
    if mesh.texture is None and len(mesh.faces) <= max_faces:
        return None
    colors = mesh.colors_rgb
    if mesh.texture is not None and mesh.uv is not None:
        # A vertex of a coarser mesh shows the mean of some texels.
        height, width = (max(1, side // 4) for side in mesh.texture.shape[:2])
        means = cv2.resize(mesh.texture, (width, height), interpolation=cv2.INTER_AREA)
        places = (mesh.uv * [width, -height] + [0, height]).astype(int)
        colors = np.asarray(means[places[:, 1].clip(0, height - 1), places[:, 0].clip(0, width - 1)], np.uint8)
    # A texture divides a vertex where the parts of its atlas meet; joined again, the surface stays closed.
    _, first, joined = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    whole = SharedMesh(
        mesh.vertices[first],
        joined.reshape(-1)[mesh.faces].astype(np.int32),
        colors[first] if colors is not None else None,
    )
    return thinned(whole, max_faces)[0]


def joined_meshes(meshes: Sequence[SharedMesh]) -> SharedMesh | None:
    """Return several meshes as one, their textures in rows; those without are left out if any has one."""
    textured = [mesh for mesh in meshes if mesh.texture is not None and mesh.uv is not None]
    used = textured or [mesh for mesh in meshes if mesh.colors_rgb is not None]
    if len(used) < 2:
        return used[0] if used else None
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in used)])
    vertices = np.concatenate([mesh.vertices for mesh in used])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(used, first, strict=False)]).astype(np.int32)
    if not textured:
        colors = [mesh.colors_rgb for mesh in used if mesh.colors_rgb is not None]
        return SharedMesh(vertices, faces, np.concatenate(colors))
    textures = [mesh.texture for mesh in used if mesh.texture is not None]
    corners, (height, width) = _in_rows([(one.shape[0], one.shape[1]) for one in textures])
    atlas, places = np.zeros((height, width, 3), np.uint8), []
    for mesh, texture, (top, left) in zip(used, textures, corners, strict=True):
        assert mesh.uv is not None
        rows, columns = texture.shape[:2]
        atlas[top : top + rows, left : left + columns] = texture
        bottom = height - top - rows  # places count from the lower-left corner
        places.append(mesh.uv * [columns / width, rows / height] + [left / width, bottom / height])
    return SharedMesh(vertices, faces, uv=np.concatenate(places).astype(np.float32), texture=atlas)


def _in_rows(sizes_hw: Sequence[tuple[int, int]]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Return the upper-left corner (top, left) of each rectangle in rows, in their order, and the size of all.

    All together are about as wide as high.
    """
    area = sum(height * width for height, width in sizes_hw)
    most = max(*(width for _, width in sizes_hw), round(area**0.5))
    corners, top, left, row = [], 0, 0, 0
    for height, width in sizes_hw:
        if left + width > most:
            top, left, row = top + row, 0, 0
        corners.append((top, left))
        left, row = left + width, max(row, height)
    used = max(start + width for (_, start), (_, width) in zip(corners, sizes_hw, strict=True))
    return corners, (top + row, used)


def _colored(run: RunOutput, name: str) -> SharedMesh:
    vertices, colors, faces = read_ply_mesh(run.out / name)
    return SharedMesh(vertices, faces, colors_rgb=colors)


def _textured(run: RunOutput, name: str, group: int) -> SharedMesh:
    arrays, texture = read_glb(run.out / name)
    uv = np.stack([arrays.uv[:, 0], 1 - arrays.uv[:, 1]], axis=-1)
    mesh = SharedMesh(arrays.positions, arrays.faces, uv=uv, texture=texture)
    exports = [stage for stage in run.summary.stages if stage.use == "export.mesh_textured"]
    if any(stage.params.get("frame") == "world" for stage in exports):  # instead of upright
        return mesh
    up = world_up(split_groups(run.poses)[group]) if run.poses is not None else WORLD_UP
    return replace(mesh, vertices=(mesh.vertices.astype(np.float64) @ y_up_from_world(up)).astype(np.float32))
