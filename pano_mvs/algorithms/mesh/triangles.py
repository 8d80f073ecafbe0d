"""A mesh of triangles, and what of it lies near points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_NEIGHBOURS = 6
# A stray point, far from all others, would else keep a large bubble around it.
_MAX_SPACING = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles with coloured corners.

    Attributes:
        vertices_in_world: (V, 3) float32, scene units.
        colors_rgb: (V, 3) uint8.
        faces: (F, 3) int32 positions of corners, counter-clockwise as seen from where the surface was seen.
    """

    vertices_in_world: NDArray[np.float32]
    colors_rgb: NDArray[np.uint8]
    faces: NDArray[np.int32]


def point_spacings(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how far the points (N, 3) lie apart around each, (N,): the median distance to its six nearest.

    Ten times the cloud's median at most.
    """
    count = min(_NEIGHBOURS + 1, len(points))
    distances, _ = cKDTree(points).query(points, k=count)
    spacings: NDArray[np.float64] = np.median(np.asarray(distances)[:, 1:], axis=1)
    return np.asarray(np.minimum(spacings, _MAX_SPACING * np.median(spacings)))


def trimmed_mesh(mesh: Mesh, points: NDArray[np.float32], *, max_spacings: float) -> Mesh:
    """Return the part of a mesh that lies near points: a solver closes what nobody has seen.

    A corner stays if it is at most `max_spacings` times as far from the nearest point as points are apart there
    (`point_spacings`), a triangle if its three corners do.

    Args:
        mesh: the mesh.
        points: (N, 3) in the world that it was made of, more than one.
        max_spacings: so many spacings; holes that are less than twice as wide stay closed.
    """
    distances, nearest = cKDTree(points).query(mesh.vertices_in_world)
    near = distances <= max_spacings * point_spacings(points)[nearest]
    return used_part(mesh, mesh.faces[near[mesh.faces].all(axis=1)])


def without_crumbs(mesh: Mesh, *, smallest_share: float) -> Mesh:
    """Return a mesh without those of its connected parts that have less than a share of all its triangles."""
    count = len(mesh.vertices_in_world)
    starts, ends = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    edges = coo_array((np.ones(len(starts), np.int8), (starts, ends)), shape=(count, count))
    _, part_of_vertex = connected_components(edges, directed=False)
    part = part_of_vertex[mesh.faces[:, 0]]
    kept = np.bincount(part, minlength=1)[part] >= smallest_share * len(part)
    return used_part(mesh, mesh.faces[kept])


def used_part(mesh: Mesh, faces: NDArray[np.int32]) -> Mesh:
    """Return some triangles of a mesh, (F, 3) positions of its corners, with the corners that they use."""
    used, positions = np.unique(faces, return_inverse=True)
    renumbered = positions.reshape(faces.shape).astype(np.int32)
    return Mesh(mesh.vertices_in_world[used], mesh.colors_rgb[used], renumbered)
