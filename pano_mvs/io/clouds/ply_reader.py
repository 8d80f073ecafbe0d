"""Read the points of PLY files of any program."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError
from pano_mvs.io.clouds.ply_frame import stated_rotation, turned
from pano_mvs.scene import PointCloud

# PLY's names of number types, old and new.
_NUMBERS = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_MARK = b"end_header"
_MAX_HEADER_BYTES = 1 << 20
_COUNT = re.compile("[0-9]{1,18}")


class _Layout(NamedTuple):
    """The layout of the vertices: their number, their properties, and whether they are text."""

    points: int
    vertex: np.dtype[np.void]
    text: bool


@dataclass(frozen=True, eq=False)
class PlyPoints:
    """The vertices of a PLY file, which need not fit in memory.

    Attributes:
        path: the file.
        count: number of vertices.
        has_normals: whether they have nx, ny, nz.
        vertices: (N,) with a field for each property, memory-mapped if the file is binary; as in the file.
        world_from_file: rotation (3, 3) into the world of the run that wrote the file; None if the header states none.
    """

    path: Path
    count: int
    has_normals: bool
    vertices: NDArray[np.void]
    world_from_file: FloatArray | None = None

    def in_world(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return vectors (K, 3) of the file in the world frame."""
        return turned(vectors, self.world_from_file)

    def chunks(self, size: int = 2_000_000) -> Iterator[NDArray[np.float32]]:
        """Yield the positions in the world, (K, 3) float32, of up to `size` vertices at a time.

        Raises:
            InputError: if a position is not finite.
        """
        for start in range(0, self.count, size):
            yield self._positions(slice(start, start + size))

    def some(self, step: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return positions and normals in the world, both (K, 3) float32, of every step-th vertex.

        Unknown normals are 0.

        Raises:
            InputError: if a position is not finite.
        """
        points = self._positions(slice(None, None, step))
        if not self.has_normals:
            return points, np.zeros_like(points)
        return points, self.in_world(np.nan_to_num(self._stacked(("nx", "ny", "nz"), slice(None, None, step))))

    def cloud_chunks(self, size: int = 1_000_000) -> Iterator[PointCloud]:
        """Yield the points in the world with all that our own files hold, up to `size` at a time.

        Colours that the file does not have are grey, and numbers of views 0.

        Raises:
            InputError: if a position is not finite.
        """
        names = set(self.vertices.dtype.names or ())
        for start in range(0, self.count, size):
            part = slice(start, min(start + size, self.count))
            positions, vertices = self._positions(part), self.vertices[part]
            normals = self._stacked(("nx", "ny", "nz"), part) if self.has_normals else np.zeros_like(positions)
            has_color = {"red", "green", "blue"} <= names
            colors = [vertices[name].astype(np.uint8) for name in ("red", "green", "blue")] if has_color else []
            yield PointCloud(
                positions,
                self.in_world(np.nan_to_num(normals)),
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

    def _stacked(self, names: tuple[str, ...], part: slice) -> NDArray[np.float32]:
        chosen = self.vertices[part]
        with np.errstate(over="ignore", invalid="ignore"):  # infinite values are refused
            return np.stack([chosen[name].astype(np.float32) for name in names], axis=-1)


def read_ply_points(path: Path) -> NDArray[np.float32]:
    """Return the positions in the world, (N, 3) float32, of the vertices in a PLY file; see `open_ply_points`.

    Raises:
        InputError: if the file cannot be read, is not such a PLY file, or ends early.
    """
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
            head, mark, rest = stream.read(_MAX_HEADER_BYTES).partition(_MARK)
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
    rotation = stated_rotation(head, path)
    return PlyPoints(path, layout.points, has_normals, vertices, None if rotation is None else rotation.T)


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
    """Return the layout of the vertices from the lines of the header.

    Raises:
        InputError: if the header is not a PLY header, or its vertices have lists.
    """
    words = [line.split() for line in lines if line.strip() and not line.startswith(("comment", "obj_info"))]
    form = next((word[1] for word in words if word[0] == "format" and len(word) == 3), "")
    elements = [idx for idx, word in enumerate(words) if word[0] == "element"]
    if words[:1] != [["ply"]] or form not in _ORDERS or not elements:
        raise InputError(f"{path}: not a PLY file: its header names no known format or no element")
    first = words[elements[0]]
    if first[1:2] != ["vertex"] or len(first) != 3 or not _COUNT.fullmatch(first[2]):
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
