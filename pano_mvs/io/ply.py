"""PLY files: clouds and meshes of our own, and the points of files of any program.

Exports may turn coordinates into the axes of other programs. The header then states that rotation as a comment, so that
reading returns coordinates of the world again.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError
from pano_mvs.io.point_selection import SelectedPoints, chunks
from pano_mvs.scene import FilePart, PointCloud

RGB = ("red", "green", "blue")
_PLAIN = [*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), *((name, "u1") for name in RGB)]
_QUALITY = [("views", "u1"), ("confidence", "u1")]
_UNCERTAINTY = [("uncertainty", "<f4")]
_LAYOUTS = [np.dtype([*_PLAIN, *more]) for more in ([], _QUALITY, _UNCERTAINTY, [*_QUALITY, *_UNCERTAINTY])]

_MESH_VERTEX = np.dtype([*((name, "<f4") for name in "xyz"), *((name, "u1") for name in RGB)])
# Our files store the number of a face's corners in one byte, which all programs read; COLMAP's in four bytes.
_FACES = {
    "property list uchar int vertex_indices": np.dtype([("count", "u1"), ("corners", "<i4", (3,))]),
    "property list int int vertex_indices": np.dtype([("count", "<i4"), ("corners", "<i4", (3,))]),
}
MeshArrays = tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]
"""Vertices (V, 3), their colours (V, 3) RGB, triangles (F, 3)."""

_FRAME_KEY = b"comment file_from_world "
_FRAME_MEANING = "comment x_in_file = file_from_world x_in_world; poses and COLMAP models are in the world\n"
_MARK = b"end_header"
# PLY's names of number types, old and new.
_NUMBERS = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float": "f4",
    "double": "f8",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


def ply_header(count: int, layout: np.dtype[np.void], *, comments: str = "", more: str = "") -> bytes:
    """Return the header of a binary little-endian file whose vertices are float32 and uint8 numbers."""
    kinds = {"f": "float", "u": "uchar"}
    properties = "".join(f"property {kinds[layout[name].kind]} {name}\n" for name in layout.names or ())
    vertices = f"element vertex {count}\n{properties}"
    return f"ply\nformat binary_little_endian 1.0\n{comments}{vertices}{more}{_MARK.decode()}\n".encode()


def write_ply(
    path: Path,
    cloud: PointCloud,
    *,
    quality: bool = False,
    uncertainty: bool = False,
    kept: SelectedPoints | None = None,
    file_from_world: FloatArray | None = None,
) -> None:
    """Write a cloud as binary little-endian PLY: x y z nx ny nz (float), red green blue (uchar).

    The cloud is written in chunks, so that memory-mapped arrays need not fit in memory.

    Args:
        quality: also write `views`, the number of views that agree on the point, and `confidence` (uchar).
        uncertainty: also write `uncertainty`, the standard deviation of the position in scene units (float); NaN if
            unknown.
        kept: the points to write; all by default.
        file_from_world: rotation (3, 3) that is applied to points and normals and stated in the header, so that
            `read_ply` can undo it; None writes coordinates of the world.
    """
    layout, count = _LAYOUTS[quality + 2 * uncertainty], len(cloud) if kept is None else kept.count
    with path.open("wb") as stream:
        stream.write(ply_header(count, layout, comments=_frame_comments(file_from_world)))
        for chunk in chunks(len(cloud)):
            written = _vertices(cloud, chunk, layout, file_from_world=file_from_world)
            stream.write((written if kept is None else written[kept.within(chunk)]).tobytes())


def write_ply_parts(
    path: Path,
    parts: Iterable[PointCloud],
    *,
    quality: bool = False,
    uncertainty: bool = False,
    file_from_world: FloatArray | None = None,
) -> int:
    """Write clouds one after the other as one PLY file, and return the number of points; see `write_ply`.

    Only one part is in memory at a time. The vertices are written beside the file first, since its header states their
    number.
    """
    layout, count = _LAYOUTS[quality + 2 * uncertainty], 0
    with tempfile.TemporaryFile(dir=path.parent) as body:
        for part in parts:
            body.write(_vertices(part, slice(0, len(part)), layout, file_from_world=file_from_world).tobytes())
            count += len(part)
        body.seek(0)
        with path.open("wb") as stream:
            stream.write(ply_header(count, layout, comments=_frame_comments(file_from_world)))
            shutil.copyfileobj(body, stream, 1 << 20)
    return count


def read_ply(path: Path) -> PointCloud:
    """Return the cloud in a PLY file, in the world frame, as far as the file states it; see `open_ply_points`.

    Raises:
        InputError: as `open_ply_points`, or if a point has no finite position.
    """
    points = open_ply_points(path)
    cloud = points.cloud(slice(0, points.count))
    is_known = cloud.uncertainty is not None and np.isfinite(cloud.uncertainty).all()
    return cloud if is_known else replace(cloud, uncertainty=None)


def write_ply_mesh(path: Path, mesh: MeshArrays, *, file_from_world: FloatArray | None = None) -> None:
    """Write a mesh as binary little-endian PLY: x y z red green blue, and triangles as lists of three corners.

    Args:
        mesh: vertices (V, 3) float32, colours (V, 3) uint8, triangles (F, 3) int32.
        file_from_world: as in `write_ply`.
    """
    points, colors, triangles = mesh
    points = _turned(points, file_from_world)
    form, layout = next(iter(_FACES.items()))
    vertices, faces = np.zeros(len(points), _MESH_VERTEX), np.zeros(len(triangles), layout)
    for idx, (axis, color) in enumerate(zip("xyz", RGB, strict=True)):
        vertices[axis], vertices[color] = points[:, idx], colors[:, idx]
    faces["count"], faces["corners"] = 3, triangles
    more = _face_element(len(faces), form)
    with path.open("wb") as stream:
        stream.write(ply_header(len(points), _MESH_VERTEX, comments=_frame_comments(file_from_world), more=more))
        stream.write(vertices.tobytes())
        stream.write(faces.tobytes())


def read_ply_mesh(path: Path) -> MeshArrays:
    """Return the mesh, in the world frame, in a PLY file that `write_ply_mesh` or COLMAP's Poisson mesher wrote.

    Raises:
        InputError: if the file cannot be read, has another layout, or ends early.
    """
    head, mark, body = FilePart(path).read_bytes().partition(_MARK + b"\n")
    counts = [int(count) for count in re.findall(rb"^element (?:vertex|face) ([0-9]{1,18})$", head, re.MULTILINE)]
    plain = _without_comments(head) + mark
    layouts = [
        layout
        for form, layout in _FACES.items()
        if len(counts) == 2 and plain == ply_header(counts[0], _MESH_VERTEX, more=_face_element(counts[1], form))
    ]
    if not layouts:
        raise InputError(f"{path}: not a PLY mesh of pano-mvs or COLMAP (x y z red green blue, and triangles)")
    split = counts[0] * _MESH_VERTEX.itemsize
    if len(body) != split + counts[1] * layouts[0].itemsize:
        raise InputError(
            f"{path}: its header states {counts[0]} vertices and {counts[1]} faces, but it contains other "
            "numbers. Write it again"
        )
    vertices, faces = np.frombuffer(body[:split], _MESH_VERTEX), np.frombuffer(body[split:], layouts[0])
    if (faces["count"] != 3).any():
        raise InputError(f"{path}: not all of its faces are triangles")
    points = _turned(np.stack([vertices[name] for name in "xyz"], axis=-1), _world_from_file(head, path))
    return points, np.stack([vertices[name] for name in RGB], axis=-1), faces["corners"].copy()


class _Layout(NamedTuple):
    """The layout of the vertices: their number, their properties, and whether they are text."""

    points: int
    vertex: np.dtype[np.void]
    text: bool


@dataclass(frozen=True, eq=False)
class PlyPoints:
    """The vertices of a PLY file, which need not fit in memory."""

    path: Path
    count: int
    has_normals: bool
    # (N,) with a field for each property, memory-mapped if the file is binary; as in the file
    vertices: NDArray[np.void]
    # rotation (3, 3) into the world of the run that wrote the file; None if the header states none
    world_from_file: FloatArray | None = None

    def in_world(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return vectors (K, 3) of the file in the world frame."""
        return _turned(vectors, self.world_from_file)

    def chunks(self, size: int = 2_000_000) -> Iterator[NDArray[np.float32]]:
        """Yield the positions in the world, (K, 3) float32, of up to `size` vertices at a time.

        Raises:
            InputError: if a position is not finite; the other methods raise it too.
        """
        for start in range(0, self.count, size):
            yield self._positions(slice(start, start + size))

    def some(self, step: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return positions and normals (0 if unknown) in the world, both (K, 3) float32, of every step-th vertex."""
        part = slice(None, None, step)
        return self._positions(part), self._normals(part)

    def cloud_chunks(self) -> Iterator[PointCloud]:
        """Yield the points in the world with all that our own files hold, up to a million at a time."""
        size = 1_000_000
        for start in range(0, self.count, size):
            yield self.cloud(slice(start, min(start + size, self.count)))

    def cloud(self, part: slice) -> PointCloud:
        """Return points in the world; colours that the file does not have are grey, and numbers of views 0."""
        positions, vertices = self._positions(part), self.vertices[part]
        names = set(vertices.dtype.names or ())
        colors = [vertices[name].astype(np.uint8) for name in RGB] if names.issuperset(RGB) else []
        return PointCloud(
            positions,
            self._normals(part),
            np.stack(colors, axis=-1) if colors else np.full((len(positions), 3), 128, np.uint8),
            np.array(vertices["views"], np.uint8) if "views" in names else np.zeros(len(positions), np.uint8),
            np.array(vertices["confidence"], np.uint8) if "confidence" in names else None,
            uncertainty=np.array(vertices["uncertainty"], np.float32) if "uncertainty" in names else None,
        )

    def _positions(self, part: slice) -> NDArray[np.float32]:
        points = self._stacked(("x", "y", "z"), part)
        if not np.isfinite(points).all():
            raise InputError(f"{self.path}: a point has no finite position. Remove such points")
        return self.in_world(points)

    def _normals(self, part: slice) -> NDArray[np.float32]:
        if not self.has_normals:
            return np.zeros((len(self.vertices[part]), 3), np.float32)
        return self.in_world(np.nan_to_num(self._stacked(("nx", "ny", "nz"), part)))

    def _stacked(self, names: tuple[str, ...], part: slice) -> NDArray[np.float32]:
        chosen = self.vertices[part]
        with np.errstate(over="ignore", invalid="ignore"):  # infinite values are refused
            return np.stack([chosen[name].astype(np.float32) for name in names], axis=-1)


def read_ply_points(path: Path) -> NDArray[np.float32]:
    """Return the positions in the world, (N, 3) float32, of the vertices in a PLY file; see `open_ply_points`."""
    return np.concatenate([np.zeros((0, 3), np.float32), *open_ply_points(path).chunks()])


def open_ply_points(path: Path) -> PlyPoints:
    """Return the vertices of a PLY file of any program.

    The file is text or binary in either byte order. The vertices must be its first element and must not contain lists;
    other properties and elements are ignored. Vertices of a binary file are memory-mapped. If the header states the
    rotation with which our exports turned the file, positions and normals are returned in the world of the run.

    Raises:
        InputError: if the file cannot be read, is not such a PLY file, or ends early.
    """
    try:
        with path.open("rb") as stream:
            head, mark, rest = stream.read(1 << 20).partition(_MARK)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Check that it exists and may be read") from error
    if not mark:
        raise InputError(f"{path}: not a PLY file: it has no end_header line")
    layout = _layout(head.decode("ascii", "replace").splitlines(), path)
    offset = len(head) + len(mark) + rest.find(b"\n") + 1
    vertices = _text_vertices(path, offset, layout) if layout.text else _binary_vertices(path, offset, layout)
    if vertices is None:
        raise InputError(f"{path}: its header states {layout.points} points, but it contains fewer. Write it again")
    has_normals = {"nx", "ny", "nz"} <= set(layout.vertex.names or ())
    return PlyPoints(path, layout.points, has_normals, vertices, _world_from_file(head, path))


def _vertices(
    cloud: PointCloud, chunk: slice, layout: np.dtype[np.void], *, file_from_world: FloatArray | None
) -> NDArray[np.void]:
    vertices = np.zeros(chunk.stop - chunk.start, layout)
    points = _turned(cloud.points_in_world[chunk], file_from_world)
    normals = _turned(cloud.normals_in_world[chunk], file_from_world)
    for idx, (axis, color) in enumerate(zip("xyz", RGB, strict=True)):
        vertices[axis], vertices[f"n{axis}"] = points[:, idx], normals[:, idx]
        vertices[color] = cloud.colors_rgb[chunk, idx]
    names = layout.names or ()
    if "views" in names:
        vertices["views"] = cloud.view_counts[chunk]
        vertices["confidence"] = 0 if cloud.confidence is None else cloud.confidence[chunk]
    if "uncertainty" in names:
        vertices["uncertainty"] = np.nan if cloud.uncertainty is None else cloud.uncertainty[chunk]
    return vertices


def _face_element(count: int, form: str) -> str:
    return f"element face {count}\n{form}\n"


def _frame_comments(file_from_world: FloatArray | None) -> str:
    """Return the lines of the header that state a rotation (3, 3), row by row; none for a file in the world frame."""
    if file_from_world is None:
        return ""
    numbers = " ".join(f"{value:.17g}" for value in np.asarray(file_from_world, np.float64).ravel())
    return f"{_FRAME_MEANING}{_FRAME_KEY.decode()}{numbers}\n"


def _without_comments(head: bytes) -> bytes:
    return b"".join(line for line in head.splitlines(keepends=True) if not line.startswith(b"comment"))


def _world_from_file(head: bytes, path: Path) -> FloatArray | None:
    """Return the rotation (3, 3) that undoes the one in a header; None if it states none."""
    line = next((line for line in head.splitlines() if line.startswith(_FRAME_KEY)), None)
    if line is None:
        return None
    try:
        rotation = np.array([float(word) for word in line[len(_FRAME_KEY) :].split()]).reshape(3, 3)
    except ValueError:
        rotation = np.zeros((3, 3))
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-6)
    if not (orthonormal and np.linalg.det(rotation) > 0):
        raise InputError(f"{path}: file_from_world in its header is not a rotation. Write the file again")
    return rotation.T


def _turned(vectors: NDArray[np.float32], target_from_source: FloatArray | None) -> NDArray[np.float32]:
    """Return vectors (N, 3) in other axes; None leaves them as they are."""
    if target_from_source is None:
        return vectors
    # In float64, so that the result does not depend on the library; adding 0 turns −0 into 0.
    return (vectors.astype(np.float64) @ target_from_source.T + 0.0).astype(np.float32)


def _binary_vertices(path: Path, offset: int, layout: _Layout) -> NDArray[np.void] | None:
    if path.stat().st_size - offset < layout.points * layout.vertex.itemsize:
        return None
    if not layout.points:  # an empty array cannot be mapped
        return np.zeros(0, layout.vertex)
    return np.memmap(path, layout.vertex, "r", offset, (layout.points,))


def _text_vertices(path: Path, offset: int, layout: _Layout) -> NDArray[np.void] | None:
    lines = path.read_bytes()[offset:].splitlines()[: layout.points]
    if len(lines) < layout.points:
        return None
    try:
        rows = [tuple(float(number) for number in line.split()) for line in lines]
        return np.array(rows, [(name, "f8") for name in layout.vertex.names or ()])
    except ValueError:  # a truncated line, or one without numbers
        return None


def _layout(lines: list[str], path: Path) -> _Layout:
    """Return the layout of the vertices by the lines of the header; InputError unless each property is one number."""
    words = [line.split() for line in lines if line.strip() and not line.startswith(("comment", "obj_info"))]
    form = next((word[1] for word in words if word[0] == "format" and len(word) == 3), "")
    elements = [idx for idx, word in enumerate(words) if word[0] == "element"]
    if words[:1] != [["ply"]] or form not in _ORDERS or not elements:
        raise InputError(f"{path}: not a PLY file: its header names no known format or no element")
    first = words[elements[0]]
    if first[1:2] != ["vertex"] or len(first) != 3 or not re.fullmatch("[0-9]{1,18}", first[2]):
        raise InputError(
            f"{path}: the first element of a PLY file must be its vertices with their number, this has "
            f"'{' '.join(first)[:80]}'"
        )
    properties = words[elements[0] + 1 : elements[1] if len(elements) > 1 else len(words)]
    if not all(len(word) == 3 and word[0] == "property" and word[1] in _NUMBERS for word in properties):
        raise InputError(f"{path}: its vertices have lists or properties of unknown types: write plain numbers")
    names = [word[2] for word in properties]
    if len(set(names)) < len(names) or not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: its vertices lack x, y or z, or have a property twice")
    vertex = np.dtype([(word[2], _ORDERS[form] + _NUMBERS[word[1]]) for word in properties])
    return _Layout(int(first[2]), vertex, form == "ascii")
