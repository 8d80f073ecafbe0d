"""A triangle mesh, and the removal of parts far from points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_NEIGHBOURS = 6
# Otherwise a stray point, far from all others, would keep a large bubble around it.
_MAX_SPACING = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles with coloured corners.

    Attributes:
        vertices_in_world: (V, 3) float32, scene units.
        colors_rgb: (V, 3) uint8.
        faces: (F, 3) int32 vertex positions, counter-clockwise as seen from the side that was seen.
    """

    vertices_in_world: NDArray[np.float32]
    colors_rgb: NDArray[np.uint8]
    faces: NDArray[np.int32]


def point_spacings(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the spacing of points (N, 3) around each, (N,): the median distance to its six nearest neighbours.

    At most ten times the cloud's median.
    """
    count = min(_NEIGHBOURS + 1, len(points))
    distances, _ = cKDTree(points).query(points, k=count)
    spacings: NDArray[np.float64] = np.median(np.asarray(distances)[:, 1:], axis=1)
    return np.asarray(np.minimum(spacings, _MAX_SPACING * np.median(spacings)))


def trimmed_mesh(mesh: Mesh, points: NDArray[np.float32], *, max_spacings: float) -> Mesh:
    """Return the part of a mesh near points; a solver also closes surfaces that were not seen.

    A vertex is kept if its distance to the nearest point is at most `max_spacings` times the point spacing there
    (`point_spacings`), a triangle if its three vertices are.

    Args:
        mesh: the mesh.
        points: (N, 3) in the world from which the mesh was made, more than one.
        max_spacings: maximum distance in point spacings; holes narrower than twice this distance stay closed.
    """
    distances, nearest = cKDTree(points).query(mesh.vertices_in_world)
    near = distances <= max_spacings * point_spacings(points)[nearest]
    return used_part(mesh, mesh.faces[near[mesh.faces].all(axis=1)])


def without_crumbs(mesh: Mesh, *, smallest_share: float) -> Mesh:
    """Return a mesh without connected parts that have less than a given share of all its triangles."""
    count = len(mesh.vertices_in_world)
    starts, ends = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    edges = coo_array((np.ones(len(starts), np.int8), (starts, ends)), shape=(count, count))
    _, part_of_vertex = connected_components(edges, directed=False)
    part = part_of_vertex[mesh.faces[:, 0]]
    kept = np.bincount(part, minlength=1)[part] >= smallest_share * len(part)
    return used_part(mesh, mesh.faces[kept])


def used_part(mesh: Mesh, faces: NDArray[np.int32]) -> Mesh:
    """Return a subset of a mesh's triangles, (F, 3) vertex positions, with the vertices that they use."""
    used, positions = np.unique(faces, return_inverse=True)
    renumbered = positions.reshape(faces.shape).astype(np.int32)
    return Mesh(mesh.vertices_in_world[used], mesh.colors_rgb[used], renumbered)
