"""A mesh as pieces that the page draws: compact, and with indices of two bytes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.share.encoding import encode_arrays, quantised
from pano_mvs.share.mesh_file import SharedMesh

PIECE_FACES = 20_000
"""Largest number of triangles of a piece; even if no two share a corner, two bytes count its vertices."""

_Z_BITS = 10


@dataclass(frozen=True, eq=False)
class VertexFacts:
    """What the page knows of vertices besides their place and colour.

    Attributes:
        sigma_steps: (V,) uint8 steps of the standard deviation of the position; 0 if unknown.
        view_counts: (V,) uint8 number of views that agree on the surface there.
    """

    sigma_steps: NDArray[np.uint8]
    view_counts: NDArray[np.uint8]


def mesh_pieces(mesh: SharedMesh, facts: VertexFacts) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the pieces of a mesh: what the page needs to know of it, and its arrays as base64.

    The arrays are places within a cube (V, 3) uint16, places in the texture (V, 2) uint16 if there is one, corners
    (F, 3) uint16, colours (V, 3) uint8 if there is no texture, steps of the standard deviation (V,) uint8 and view
    counts (V,) uint8.

    Args:
        mesh: the mesh, in the frame of the page.
        facts: of its vertices.
    """
    for chosen in _divided(mesh):
        used, corners = _by_first_use(mesh.faces[chosen])
        vertices = mesh.vertices[used]
        lower = vertices.min(axis=0).astype(np.float64)
        size = float((vertices.max(axis=0) - lower).max()) * (1 + 1e-6) or 1.0
        parts: list[NDArray[np.generic]] = [quantised(vertices, lower, size)]
        if mesh.uv is not None:
            parts.append(np.rint(mesh.uv[used].clip(0, 1) * 65535).astype("<u2"))
        parts.append(corners.astype("<u2"))
        if mesh.colors_rgb is not None:
            parts.append(mesh.colors_rgb[used])
        parts += [facts.sigma_steps[used], facts.view_counts[used]]
        described = {"lower": lower.tolist(), "size": size, "vertices": len(used), "faces": len(chosen)}
        yield described, encode_arrays(*parts)


def _by_first_use(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Return the vertices that faces use, in the order of their first use, and the faces' corners among them."""
    used, first, corners = np.unique(faces, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.intp)
    rank[order] = np.arange(len(order))
    return used[order], rank[corners.reshape(faces.shape)]


def _divided(mesh: SharedMesh) -> Iterator[NDArray[np.int64]]:
    """Yield the triangles of each piece.

    They follow a Z-order curve, so that a piece is compact, and triangles that share corners are near each other in the
    order of drawing, which spares graphics processors to compute the corners again.
    """
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    order = np.argsort(z_order(centers), kind="stable")
    for first in range(0, len(order), PIECE_FACES):
        yield order[first : first + PIECE_FACES]


def z_order(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the positions of points (N, 3) along a Z-order curve through their cube (N,), in 2^10 cells per side."""
    if not len(points):
        return np.zeros(0, np.int64)
    lower = points.min(axis=0)
    size = float(np.ptp(points, axis=0).max()) or 1.0
    cells = ((points - lower) / size * (1 << _Z_BITS)).astype(np.int64).clip(0, (1 << _Z_BITS) - 1)
    codes = np.zeros(len(points), np.int64)
    for bit in range(_Z_BITS):
        for axis in range(3):
            codes |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return codes
