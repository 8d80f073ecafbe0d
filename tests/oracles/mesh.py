"""Obvious numpy versions of what is compiled for meshes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.atlas import Texels
from pano_mvs.algorithms.mesh.kernels_mesh import MIN_COSINE, RANGE_TOLERANCE, SLOPE_PX
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pad_panorama, pixel_from_ray, ray_grid, sample_panorama


def nearest_triangles(corners_in_cam: FloatArray, size_hw: tuple[int, int]) -> tuple[FloatArray, NDArray[np.int64]]:
    """Intersect each ray with each triangle (Möller & Trumbore 1997): range, infinite if none, and triangle."""
    rays = ray_grid(size_hw).reshape(-1, 3)
    ranges, triangle = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for idx, (a, b, c) in enumerate(corners_in_cam):
        normal_of_b = np.cross(rays, c - a)
        volume = normal_of_b @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            of_b = normal_of_b @ -a / volume
            crossed = np.cross(-a, b - a)
            of_c = rays @ crossed / volume
            distance = (c - a) @ crossed / volume
        hit = (np.abs(volume) > 1e-12) & (of_b >= 0) & (of_c >= 0) & (of_b + of_c <= 1) & (distance > 0)
        nearer = hit & (distance < ranges)
        ranges[nearer], triangle[nearer] = distance[nearer], idx
    return ranges.reshape(size_hw), triangle.reshape(size_hw)


def texel_looks(
    texels: Texels,
    mesh: tuple[FloatArray, FloatArray, NDArray[np.int32]],
    view: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The weight, the colour without detail and the detail of each texel; colours only where there is a weight."""
    vertices, normals, faces = mesh
    ranges, quality, picture, smooth = view
    weights = np.column_stack([1 - texels.weights.sum(axis=1, dtype=np.float64), texels.weights])
    corner = faces[texels.triangle]
    points = np.einsum("tk,tkc->tc", weights, vertices[corner])
    normal = np.einsum("tk,tkc->tc", weights, normals[corner])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distance = np.linalg.norm(points, axis=1)
    cosine = -np.sum(points * normal, axis=1) / distance
    height, width = ranges.shape
    at = pixel_from_ray(points, (height, width))
    left, top = (np.floor(at - 0.5).astype(int) + 1).T
    around = [
        pad_panorama(values, 1)[top[:, None] + [0, 0, 1, 1], left[:, None] + [0, 1, 0, 1]].min(axis=1)
        for values in (ranges, quality)
    ]
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = SLOPE_PX * np.pi / height * np.sqrt(1 - np.minimum(cosine**2, 1)) / cosine
    seen = (cosine >= MIN_COSINE) & (distance <= around[0] * (1 + RANGE_TOLERANCE + slope))
    base = sample_panorama(smooth, at)
    weight = np.where(seen, around[1] * cosine / distance**2, 0.0)
    return weight, base, sample_panorama(picture, at) - base
