"""The surface that a run exported, textured or with coloured vertices."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ply import read_ply_mesh
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import WORLD_UP, world_up, y_up_from_world
from pano_mvs.share.glb_file import read_glb

TEXTURED = "mesh_textured.glb"
COLORED = "mesh.ply"


@dataclass(frozen=True, eq=False)
class SharedMesh:
    """Triangles with a texture, or else with coloured vertices.

    Attributes:
        vertices: (V, 3) float32.
        faces: (F, 3) int32, anticlockwise as seen from the side that was seen.
        colors_rgb: (V, 3) uint8; None with a texture.
        uv: (V, 2) float32 places in the texture, from its lower-left corner; None without a texture.
        texture: (H, W, 3) uint8 RGB; None without a texture.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    colors_rgb: NDArray[np.uint8] | None = None
    uv: NDArray[np.float32] | None = None
    texture: NDArray[np.uint8] | None = None

    def moved(self, target_from_source: Rigid3) -> SharedMesh:
        """Return the mesh in another frame."""
        return replace(self, vertices=target_from_source.apply(self.vertices).astype(np.float32))


def run_mesh(run: RunOutput) -> tuple[SharedMesh | None, str]:
    """Return the mesh of the largest group of a run in the world frame, and a note; the textured one if there are two.

    Files that an earlier run left behind are not used.

    Returns:
        The mesh, or None if there is none or it cannot be read; and what the reader of the page should know, or "".
    """
    notes = []
    for name in (TEXTURED, COLORED):
        if not run.has_file(name):
            continue
        try:
            mesh = _textured(run) if name == TEXTURED else _colored(run)
        except InputError as error:
            notes.append(str(error))
            continue
        if len(mesh.faces):
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


def _colored(run: RunOutput) -> SharedMesh:
    vertices, colors, faces = read_ply_mesh(run.out / COLORED)
    return SharedMesh(vertices, faces, colors_rgb=colors)


def _textured(run: RunOutput) -> SharedMesh:
    made = read_glb(run.out / TEXTURED)
    poses: Poses | None = split_groups(run.poses)[0] if run.poses is not None else None
    file_from_world = y_up_from_world(world_up(poses) if poses is not None else WORLD_UP)
    if _is_in_world(run):
        file_from_world = np.eye(3)
    return SharedMesh(
        (made.positions.astype(np.float64) @ file_from_world).astype(np.float32),
        made.faces,
        uv=np.asarray(np.stack([made.uv[:, 0], 1 - made.uv[:, 1]], axis=-1), np.float32),
        texture=made.texture,
    )


def _is_in_world(run: RunOutput) -> bool:
    """Return whether the run was asked to write meshes in the frame of the poses instead of upright."""
    return any(
        stage.use == "export.mesh_textured" and stage.params.get("frame") == "world" for stage in run.summary.stages
    )
