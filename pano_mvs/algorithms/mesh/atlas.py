"""Unwrapping of a mesh into charts of a texture, by the package xatlas, and the texels of the charts."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

# Time grows with the square of the number of charts of a part: 100,000 triangles of a room take 10 CPU-s in 64 parts
# (706 charts), 28 in 4 parts (632 charts), and over 97 as a whole.
_TRIANGLES_OF_PART = 3000


@dataclass(frozen=True, slots=True, eq=False)
class Atlas:
    """A mesh whose vertices have positions in a texture; a vertex on the border of charts occurs once for each.

    `vertex`: (N,) int32 index of the vertex of the mesh at each vertex of the atlas. `uv`: (N, 2) float32 position in
    the texture, (0, 0) its upper-left and (1, 1) its lower-right corner. `faces`: (F, 3) int32 positions in `vertex`;
    the triangles of the mesh, in its order. `size_hw`: (height, width) of the texture in texels.
    """

    vertex: NDArray[np.int32]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]
    size_hw: tuple[int, int]

    @property
    def uv_px(self) -> NDArray[np.float64]:
        """The corners of each triangle in texels, (F, 3, 2), (x, y)."""
        height, width = self.size_hw
        return np.ascontiguousarray(self.uv.astype(np.float64)[self.faces] * (width, height))


@dataclass(frozen=True, slots=True, eq=False)
class Texels:
    """The texels in the charts of an atlas.

    `pixel`: (T,) int32 index of each texel in the texture, row by row. `triangle`: (T,) int32 its triangle. `weights`:
    (T, 2) float32 weights of the triangle's second and third corner at the texel's centre.
    """

    pixel: NDArray[np.int32]
    triangle: NDArray[np.int32]
    weights: NDArray[np.float32]


def unwrapped(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    *,
    texels_per_unit: float,
    max_px: int,
    region: NDArray[np.int64] | None = None,
) -> Atlas:
    """Return the charts of a mesh in one texture.

    `vertices`: (V, 3). `faces`: (F, 3), at least one. `texels_per_unit`: resolution of the texture: texels per scene
    unit. `max_px`: largest width and height of the texture; it lowers the resolution. `region`: (F,) number of the
    plane on which each triangle lies, −1 for none; None: none does. No chart contains triangles of several planes.
    """
    xatlas = import_module("xatlas")
    corners = vertices.astype(np.float64)[faces]
    area = float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())
    most = max_px * np.sqrt(0.75 / max(area / 2, 1e-30))  # three quarters of a texture are used
    texels = float(min(texels_per_unit, most))
    # xatlas takes triangles of less than 1e-7 for empty: in small units all of them, in large ones not even slivers,
    # whose charts become very long. So triangles have 1/500 on average, as those of a room in metres. A power of 2
    # changes no digits.
    scale = 2.0 ** np.round(np.log2(len(faces) / max(area / 2, 1e-30) / 500) / 2)
    atlas = xatlas.Atlas()
    parts = []
    for number in np.unique(region) if region is not None else [-1]:
        own = np.flatnonzero(region == number) if region is not None else np.arange(len(faces))
        # A plane is one chart, however many triangles it has.
        divided = _parts(corners[own].mean(axis=1)) if number < 0 else [np.arange(len(own))]
        parts += [(own[part], *np.unique(faces[own[part]], return_inverse=True)) for part in divided]
    for part, used, local in parts:
        atlas.add_mesh((scale * vertices[used]).astype(np.float32), local.reshape(len(part), 3).astype(np.uint32))
    options = xatlas.PackOptions()
    # Texels between charts: half of them belong to each of two neighbours, enough for two levels of a mipmap.
    options.padding, options.texels_per_unit = 4, float(texels / scale)
    atlas.generate(pack_options=options)
    made = [atlas.get_mesh(number) for number in range(len(parts))]
    of_atlas, first = np.empty_like(faces, np.int32), 0
    for (part, _, _), (vertex, corners_of_faces, _) in zip(parts, made, strict=True):
        of_atlas[part] = corners_of_faces + first
        first += len(vertex)
    vertex = np.concatenate([used[own] for (_, used, _), (own, _, _) in zip(parts, made, strict=True)])
    uv = np.concatenate([own for _, _, own in made])
    shrink = min(1.0, max_px / max(atlas.width, atlas.height, 1))
    size_hw = max(1, round(atlas.height * shrink)), max(1, round(atlas.width * shrink))
    return Atlas(vertex.astype(np.int32), uv.astype(np.float32), of_atlas, size_hw)


def _parts(centers: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Return the triangles of each part of a mesh: halves along the longest side, until they are small enough."""
    parts, small = [np.arange(len(centers))], []
    while parts:
        part = parts.pop()
        if len(part) <= _TRIANGLES_OF_PART:
            small.append(part)
            continue
        own = centers[part]
        order = np.argsort(own[:, np.argmax(np.ptp(own, axis=0))], kind="stable")
        parts += [part[np.sort(half)] for half in np.array_split(order, 2)]
    return small


def texels_of(atlas: Atlas) -> Texels:
    """Return the texels whose centres are in a chart."""
    from pano_mvs.algorithms.mesh.kernels_mesh import draw_charts  # compiles on import

    triangle = np.full(atlas.size_hw, -1, np.int32)
    weights = np.zeros((*atlas.size_hw, 2), np.float32)
    draw_charts(atlas.uv_px, triangle, weights)
    pixel = np.flatnonzero(triangle >= 0).astype(np.int32)
    return Texels(pixel, triangle.ravel()[pixel], weights.reshape(-1, 2)[pixel])
