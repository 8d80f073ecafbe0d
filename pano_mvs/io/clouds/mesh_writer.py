"""Meshes as binary PLY files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError
from pano_mvs.io.clouds.ply_frame import frame_comments, stated_rotation, turned, without_comments
from pano_mvs.scene import FilePart

_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
# Our files store the number of a face's corners in one byte, which all programs read; COLMAP's in four bytes.
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])
_COLMAP_FACE = np.dtype([("count", "<i4"), ("corners", "<i4", (3,))])
_FACE_PROPERTIES = {
    "property list uchar int vertex_indices": _FACE,
    "property list int int vertex_indices": _COLMAP_FACE,
}

MeshArrays = tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]
"""Vertices (V, 3), their colours (V, 3) RGB, triangles (F, 3)."""


def write_ply_mesh(path: Path, mesh: MeshArrays, *, file_from_world: FloatArray | None = None) -> None:
    """Write a mesh as binary little-endian PLY: x y z red green blue, and triangles as lists of three corners.

    Args:
        path: the file to write.
        mesh: vertices (V, 3) float32, colours (V, 3) uint8, triangles (F, 3) int32.
        file_from_world: rotation (3, 3) that is applied to the vertices and stated in the header, so that
            `read_ply_mesh` can undo it; None writes coordinates of the world.
    """
    points, colors, triangles = mesh
    points = turned(points, file_from_world)
    vertices, faces = np.zeros(len(points), _VERTEX), np.zeros(len(triangles), _FACE)
    for idx, (axis, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertices[axis], vertices[color] = points[:, idx], colors[:, idx]
    faces["count"], faces["corners"] = 3, triangles
    with path.open("wb") as stream:
        form = "property list uchar int vertex_indices"
        stream.write(_header(len(vertices), len(faces), form, comments=frame_comments(file_from_world)))
        stream.write(vertices.tobytes())
        stream.write(faces.tobytes())


def read_ply_mesh(path: Path) -> MeshArrays:
    """Return the mesh, in the world frame, in a PLY file that `write_ply_mesh` or COLMAP's Poisson mesher wrote.

    Raises:
        InputError: if the file cannot be read, has another layout, or ends early.
    """
    head, mark, body = FilePart(path).read_bytes().partition(b"end_header\n")
    counts = [int(count) for count in re.findall(rb"^element (?:vertex|face) ([0-9]{1,18})$", head, re.MULTILINE)]
    plain = without_comments(head) + mark
    layouts = [
        layout
        for line, layout in _FACE_PROPERTIES.items()
        if len(counts) == 2 and plain == _header(counts[0], counts[1], line)
    ]
    if not layouts:
        raise InputError(f"{path}: not a PLY mesh of pano-mvs or COLMAP (x y z red green blue, and triangles)")
    split = counts[0] * _VERTEX.itemsize
    if len(body) != split + counts[1] * layouts[0].itemsize:
        raise InputError(
            f"{path}: its header states {counts[0]} vertices and {counts[1]} faces, but it contains other "
            "numbers. Write it again"
        )
    vertices, faces = np.frombuffer(body[:split], _VERTEX), np.frombuffer(body[split:], layouts[0])
    if (faces["count"] != 3).any():
        raise InputError(f"{path}: not all of its faces are triangles")
    rotation = stated_rotation(head, path)
    points = turned(np.stack([vertices[name] for name in "xyz"], axis=-1), None if rotation is None else rotation.T)
    return points, np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1), faces["corners"].copy()


def _header(vertices: int, faces: int, face_property: str, *, comments: str = "") -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *comments.splitlines(),
        f"element vertex {vertices}",
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {faces}",
        face_property,
        "end_header",
        "",
    ]
    return "\n".join(lines).encode()
