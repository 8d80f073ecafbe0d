"""What of a mesh a panorama sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceView:
    """The nearest surface of a mesh along the ray of each pixel.

    `ranges`: (H, W) float32 distance along the ray through the pixel's centre; infinite without a surface. `triangle`:
    (H, W) int32 index of the triangle; −1 without a surface. `weights`: (H, W, 2) float32 barycentric weights of the
    triangle's second and third corner.
    """

    ranges: NDArray[np.float32]
    triangle: NDArray[np.int32]
    weights: NDArray[np.float32]


def surface_view(
    vertices_in_world: NDArray[np.float32],
    faces: NDArray[np.int32],
    cam_from_world: Rigid3,
    *,
    size_hw: tuple[int, int],
    threads: int = 1,
) -> SurfaceView:
    """Return what a panorama sees of a mesh; triangles hide each other from both sides.

    Each triangle is drawn on the sphere: a ray d meets the triangle (a, b, c) if d · (b × c), d · (c × a) and
    d · (a × b) have the sign of a · (b × c), so that no projection plane and no clipping is needed (M. Olano and
    T. Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997).

    `vertices_in_world`: (V, 3). `faces`: (F, 3) positions of vertices. `cam_from_world`: pose of the panorama.
    `size_hw`: (height, width) of the panorama. `threads`: number of threads; the result does not depend on it.

    Raises:
        UsageError: if the size is not that of a full sphere.
    """
    from pano_mvs.algorithms.mesh.kernels_mesh import draw_triangles, pixel_bounds  # compiles on import

    height, width = size_hw
    if width != 2 * height or height < 1:
        raise UsageError(f"a panorama is twice as wide as high, got {width}×{height} pixels")
    corners = np.ascontiguousarray(cam_from_world.apply(vertices_in_world)[faces])
    bounds = np.zeros((len(faces), 4), np.int32)
    pixel_bounds(corners, (height, width), bounds)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    directions = np.cos(elevation), np.sin(elevation), np.cos(azimuth), np.sin(azimuth)
    targets = (
        np.full(size_hw, np.inf, np.float32),
        np.full(size_hw, -1, np.int32),
        np.zeros((*size_hw, 2), np.float32),
    )

    def draw(first: int, rows: int) -> None:
        draw_triangles(corners, bounds, directions, (first, first + rows), targets)

    for_bands(draw, height, threads=threads)
    return SurfaceView(*targets)


def vertex_normals(vertices_in_world: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return the unit normal at each vertex, (V, 3): the mean of its triangles' normals, weighted by area.

    The normal of a vertex without a triangle with an area is 0.
    """
    corners = vertices_in_world.astype(np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    count = len(vertices_in_world)
    sums = np.stack(
        [sum(np.bincount(faces[:, corner], normals[:, axis], count) for corner in range(3)) for axis in range(3)],
        axis=-1,
    )
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    unit: NDArray[np.float32] = np.divide(sums, length, out=np.zeros_like(sums), where=length > 0).astype(np.float32)
    return unit
