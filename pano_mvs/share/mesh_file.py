"""The surface that a run exported, textured or with coloured vertices."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file
from pano_mvs.geometry import Rigid3
from pano_mvs.io.clouds.mesh_writer import read_ply_mesh
from pano_mvs.results.run_output import RunOutput

TEXTURED = "mesh_textured/mesh.glb"
COLORED = "mesh.ply"

# glTF has y up and looks along +z; the world of the poses has y down.
_GLB_FROM_WORLD = np.diag([1.0, -1.0, -1.0])


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

    Args:
        run: the output of a run.

    Returns:
        The mesh, or None if there is none or it cannot be read; and what the reader of the page should know, or "".
    """
    found = [name for name in (TEXTURED, COLORED) if _is_current(run, name)]
    notes = []
    for name in found:
        try:
            mesh = _read_glb(run.out / name) if name == TEXTURED else _read_ply(run.out / name)
        except InputError as error:
            notes.append(str(error))
        else:
            return mesh, "; ".join(notes)
    return None, "; ".join(notes)


def thinned(mesh: SharedMesh, max_faces: int) -> tuple[SharedMesh, str]:
    """Return a mesh with coloured vertices with at most about `max_faces` triangles, and a note.

    A textured mesh is returned as it is, because the places in its texture would be lost; `export.mesh_textured`
    thins the mesh before it is unwrapped.

    Args:
        mesh: the mesh.
        max_faces: number of triangles; 0 for all.
    """
    if mesh.texture is not None or not 0 < max_faces < len(mesh.faces):
        return mesh, ""
    try:
        import fast_simplification  # type: ignore[import-untyped]
    except ImportError:
        return mesh, f"all {len(mesh.faces):,} triangles are written; to thin them: pip install 'pano-mvs[mesh]'"
    from scipy.spatial import cKDTree

    vertices, faces = fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=max_faces)
    nearest = cKDTree(mesh.vertices).query(vertices)[1]
    colors = mesh.colors_rgb[nearest] if mesh.colors_rgb is not None else None
    return SharedMesh(vertices.astype(np.float32), faces.astype(np.int32), colors), ""


def _is_current(run: RunOutput, name: str) -> bool:
    return is_file(run.out / name) and name not in run.summary.left_over


def _read_ply(path: Path) -> SharedMesh:
    vertices, colors, faces = read_ply_mesh(path)
    return SharedMesh(vertices, faces, colors_rgb=colors)


def _read_glb(path: Path) -> SharedMesh:
    """Return the mesh of a GLB file with one texture, in the world frame.

    Raises:
        InputError: if trimesh is not installed, or the file has no textured mesh.
    """
    try:
        import trimesh
    except ImportError as error:
        raise InputError(f"{path} was left out: to read it, pip install 'pano-mvs[mesh]'") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = trimesh.load_scene(path)
        parts = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh)]
    except (ValueError, KeyError, IndexError, OSError, TypeError, AttributeError) as error:
        raise InputError(f"{path} was left out: not a GLB file that trimesh can read ({error})") from error
    textured = [part for part in parts if _picture(part) is not None]
    if len(textured) != 1:
        raise InputError(f"{path} was left out: it has {len(textured)} textured meshes instead of 1")
    part: Any = textured[0]
    world_from_glb = _stated_rotation(loaded.metadata).T
    return SharedMesh(
        (np.asarray(part.vertices) @ world_from_glb.T).astype(np.float32),
        np.asarray(part.faces, np.int32),
        uv=np.asarray(part.visual.uv, np.float32),
        texture=_picture(part),
    )


def _picture(part: Any) -> NDArray[np.uint8] | None:
    material = getattr(part.visual, "material", None)
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return np.asarray(picture.convert("RGB"), np.uint8) if picture is not None else None


def _stated_rotation(metadata: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return the rotation file_from_world (3, 3) that the file states, or that of a world with y down."""
    stated: ArrayLike | None = metadata.get("file_from_world")
    rotation = np.asarray(stated, np.float64).reshape(-1) if stated is not None else _GLB_FROM_WORLD.reshape(-1)
    return rotation.reshape(3, 3) if rotation.size == 9 else _GLB_FROM_WORLD
