"""The surface that a run exported: a textured mesh as binary glTF 2.0 (GLB), or a mesh with coloured vertices."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ply import read_ply_mesh
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene import FilePart
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import WORLD_UP, world_up, y_up_from_world

_TEXELS = 4  # along a side, of which a vertex of a coarser mesh shows the mean

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
        height, width = (max(1, side // _TEXELS) for side in mesh.texture.shape[:2])
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


def _colored(run: RunOutput) -> SharedMesh:
    vertices, colors, faces = read_ply_mesh(run.out / COLORED)
    return SharedMesh(vertices, faces, colors_rgb=colors)


def _textured(run: RunOutput) -> SharedMesh:
    mesh = read_glb(run.out / TEXTURED)
    exports = [stage for stage in run.summary.stages if stage.use == "export.mesh_textured"]
    if any(stage.params.get("frame") == "world" for stage in exports):  # instead of upright
        return mesh
    up = world_up(split_groups(run.poses)[0]) if run.poses is not None else WORLD_UP
    return replace(mesh, vertices=(mesh.vertices.astype(np.float64) @ y_up_from_world(up)).astype(np.float32))


_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES: dict[int, np.dtype[Any]] = {5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def read_glb(path: Path) -> SharedMesh:
    """Return the mesh of a GLB file as `export.mesh_textured` writes it: one primitive, and one texture in the file.

    The vertices are in the axes of the file.

    Raises:
        InputError: if the file cannot be read or has another layout.
    """
    data = FilePart(path).read_bytes()
    try:
        document, binary = _chunks(data)
        (primitive,) = document["meshes"][0]["primitives"]
        arrays = [
            _accessor(document, binary, number)
            for number in (
                primitive["attributes"]["POSITION"],
                primitive["attributes"]["TEXCOORD_0"],
                primitive["indices"],
            )
        ]
        material = document["materials"][primitive["material"]]["pbrMetallicRoughness"]["baseColorTexture"]
        image = document["images"][document["textures"][material["index"]]["source"]]
        encoded = np.frombuffer(_view(document, binary, image["bufferView"]), np.uint8)
        picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        faces = arrays[2].reshape(-1, 3).astype(np.int32)
        fits = len(arrays[0]) == len(arrays[1]) and (not faces.size or int(faces.max()) < len(arrays[0]))
    except (ValueError, KeyError, IndexError, TypeError, struct.error, cv2.error) as error:
        raise InputError(
            f"{path}: not a textured mesh of pano-mvs in GLB ({error!r}). Run the workflow again"
        ) from error
    if picture is None or not fits:
        raise InputError(f"{path}: its texture or its triangles are damaged. Run the workflow again")
    texture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
    from_upper_left = arrays[1].astype(np.float32)
    uv = np.stack([from_upper_left[:, 0], 1 - from_upper_left[:, 1]], axis=-1)
    return SharedMesh(arrays[0].astype(np.float32), faces, uv=uv, texture=texture)


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the description and the binary part of a GLB file."""
    magic, version, length = struct.unpack_from("<III", data)
    if (magic, version, length) != (_MAGIC, 2, len(data)):
        raise ValueError("its header is not that of a complete GLB file, version 2")
    chunks: dict[int, bytes] = {}
    offset = 12
    while offset < len(data):
        size, kind = struct.unpack_from("<II", data, offset)
        chunks[kind] = data[offset + 8 : offset + 8 + size]
        offset += 8 + size
    document: dict[str, Any] = json.loads(chunks[_JSON])
    return document, chunks[_BINARY]


def _view(document: dict[str, Any], binary: bytes, number: int) -> bytes:
    view = document["bufferViews"][number]
    start = view.get("byteOffset", 0)
    if view.get("byteStride"):
        raise ValueError("interleaved arrays")
    return binary[start : start + view["byteLength"]]


def _accessor(document: dict[str, Any], binary: bytes, number: int) -> NDArray[Any]:
    accessor = document["accessors"][number]
    width = _WIDTHS[accessor["type"]]
    values = np.frombuffer(
        _view(document, binary, accessor["bufferView"]),
        _TYPES[accessor["componentType"]],
        accessor["count"] * width,
        accessor.get("byteOffset", 0),
    )
    return values.reshape(-1, width) if width > 1 else values
