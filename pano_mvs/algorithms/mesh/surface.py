"""The surface of a mesh: its computation, its reduction, and the removal of parts that nothing confirms."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.view_quality import face_normals
from pano_mvs.algorithms.mesh.volume import Surface
from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file

_NEIGHBOURS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles with coloured corners."""

    vertices_in_world: NDArray[np.float32]  # (V, 3) float32, scene units
    colors_rgb: NDArray[np.uint8]  # (V, 3) uint8
    faces: NDArray[np.int32]  # (F, 3) int32 vertex positions, counter-clockwise as seen from the side that was seen


def point_spacings(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the spacing of points (N, 3) around each, (N,): the median distance to its six nearest neighbours.

    At most ten times the cloud's median.
    """
    count = min(_NEIGHBOURS + 1, len(points))
    distances, _ = scipy.spatial.cKDTree(points).query(points, k=count)
    spacings: NDArray[np.float64] = np.median(np.asarray(distances)[:, 1:], axis=1)
    # Otherwise a stray point, far from all others, would keep a large bubble around it.
    return np.asarray(np.minimum(spacings, 10.0 * np.median(spacings)))


def trimmed_mesh(mesh: Mesh, points: NDArray[np.float32], *, max_spacings: float) -> Mesh:
    """Return the part of a mesh near points; a solver also closes surfaces that were not seen.

    A vertex is kept if its distance to the nearest point is at most `max_spacings` times the point spacing there
    (`point_spacings`), a triangle if its three vertices are.

    `mesh`: the mesh. `points`: (N, 3) in the world from which the mesh was made, more than one. `max_spacings`: maximum
    distance in point spacings; holes narrower than twice this distance stay closed.
    """
    distances, nearest = scipy.spatial.cKDTree(points).query(mesh.vertices_in_world)
    near = distances <= max_spacings * point_spacings(points)[nearest]
    return used_part(mesh, mesh.faces[near[mesh.faces].all(axis=1)])


def without_crumbs(mesh: Mesh, *, smallest_share: float) -> Mesh:
    """Return a mesh without connected parts that have less than a given share of all its triangles."""
    count = len(mesh.vertices_in_world)
    starts, ends = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    edges = scipy.sparse.coo_array((np.ones(len(starts), np.int8), (starts, ends)), shape=(count, count))
    _, part_of_vertex = scipy.sparse.csgraph.connected_components(edges, directed=False)
    part = part_of_vertex[mesh.faces[:, 0]]
    kept = np.bincount(part, minlength=1)[part] >= smallest_share * len(part)
    return used_part(mesh, mesh.faces[kept])


def used_part(mesh: Mesh, faces: NDArray[np.int32]) -> Mesh:
    """Return a subset of a mesh's triangles, (F, 3) vertex positions, with the vertices that they use."""
    used, positions = np.unique(faces, return_inverse=True)
    renumbered = positions.reshape(faces.shape).astype(np.int32)
    return Mesh(mesh.vertices_in_world[used], mesh.colors_rgb[used], renumbered)


def decimated(vertices: NDArray[np.float32], faces: NDArray[np.int32], *, triangles: int) -> Surface:
    """Return a mesh with about a given number of triangles; as it is if it has no more than that.

    Triangles without an area, and vertices without a triangle, are removed.

    `vertices`: (V, 3). `faces`: (F, 3). `triangles`: number of triangles, positive.
    """
    if len(faces) > triangles:
        library = import_module("fast_simplification")
        points, corners = library.simplify(
            np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32), target_count=triangles
        )
        vertices, faces = np.asarray(points, np.float32), np.asarray(corners, np.int32)
    faces = faces[face_normals(vertices, faces).any(axis=1)]
    used, positions = np.unique(faces, return_inverse=True)
    return vertices[used], positions.reshape(faces.shape).astype(np.int32)


MIN_POINTS = 100

# The solver crashes on some clouds, so it runs in a separate process. One cause is its own trimming, which is off. With
# several threads, the order of its sums is undefined, and the same cloud would give different bytes.
_SOLVE = """
import sys
import pycolmap
source, target, depth, point_weight = sys.argv[1:]
options = pycolmap.PoissonMeshingOptions()
options.depth, options.point_weight = int(depth), float(point_weight)
options.trim, options.color, options.num_threads = 0.0, True, 1
pycolmap.poisson_meshing(source, target, options)
"""


def poisson_depth(points: NDArray[np.float32], spacing: float) -> int:
    """Return the octree depth whose smallest cells are about as wide as the spacing of points (N, 3), 5 to 12.

    `points`: at least two points. `spacing`: median distance to their neighbours, scene units.
    """
    extent = float((points.max(axis=0) - points.min(axis=0)).max())
    cells = max(1.1 * extent / max(spacing, 1e-12), 1.0)  # the solver's cube is a tenth wider than the cloud
    return int(np.clip(np.ceil(np.log2(cells)), 5, 12))


def solve_poisson(cloud_file: Path, folder: Path, *, depth: int, point_weight: float) -> Path:
    """Compute a closed surface through oriented points, with their colours, as a PLY file of triangles.

    `cloud_file`: binary PLY with x y z nx ny nz red green blue, normals towards the side that was seen. `folder`:
    folder for the result. `depth`: depth of the octree; its smallest cells are extent / 2^depth wide. `point_weight`:
    how closely the surface follows the points; 0: the unscreened solver of 2006.

    Raises:
        InputError: if the solver fails.
    """
    target = folder / "poisson.ply"
    command = [sys.executable, "-c", _SOLVE, str(cloud_file), str(target), str(depth), str(point_weight)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)  # noqa: S603  # our own
    if done.returncode or not is_file(target):
        said = (done.stderr or done.stdout).strip()[-300:]
        raise InputError(
            f"the Poisson solver ended with code {done.returncode} at depth {depth}: try another `depth`, or fewer "
            f"points by `max_points`. Its message: {said or 'none'}"
        )
    return target
