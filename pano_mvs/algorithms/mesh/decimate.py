"""Reduction of a mesh to fewer triangles, by the package fast-simplification.

Its method is that of M. Garland and P. Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997.
"""

from __future__ import annotations

from importlib import import_module

import numpy as np
from numpy.typing import NDArray

Surface = tuple[NDArray[np.float32], NDArray[np.int32]]
"""Vertices (V, 3) and triangles (F, 3)."""


def decimated(vertices: NDArray[np.float32], faces: NDArray[np.int32], *, triangles: int) -> Surface:
    """Return a mesh with about a given number of triangles; as it is if it has no more than that.

    Triangles without an area, and vertices without a triangle, are removed.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        triangles: number of triangles, positive.
    """
    if len(faces) > triangles:
        library = import_module("fast_simplification")
        points, corners = library.simplify(
            np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32), target_count=triangles
        )
        vertices, faces = np.asarray(points, np.float32), np.asarray(corners, np.int32)
    edges = vertices[faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0]), axis=1)
    faces = faces[areas > 0]
    used, positions = np.unique(faces, return_inverse=True)
    return vertices[used], positions.reshape(faces.shape).astype(np.int32)
