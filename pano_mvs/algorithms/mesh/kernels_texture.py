"""Compiled: the colours that one panorama gives to texels, and how well it sees them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import bilinear, corners_at, pixel_from_ray

FloatArray = NDArray[np.float64]
FloatImage = NDArray[np.float32]
TexelArrays = tuple[NDArray[np.int32], NDArray[np.float32]]
MeshArrays = tuple[FloatArray, FloatArray, NDArray[np.int32]]
ViewArrays = tuple[FloatImage, FloatImage, NDArray[np.uint8], FloatImage]
Looks = tuple[FloatImage, FloatImage, FloatImage]

MIN_COSINE = 0.05  # a surface seen more edge-on is not painted
RANGE_TOLERANCE = 0.01
SLOPE_PX = 2.0


@kernel
def look_at_texels(texels: TexelArrays, mesh: MeshArrays, view: ViewArrays, span: tuple[int, int], out: Looks) -> None:
    """Write the weight and the colours that a panorama gives to the texels of `span`, [first, end).

    `texels` holds the triangle and the weights of its second and third corner; `mesh` the vertices and unit normals
    (V, 3) in camera coordinates, and the triangles. `view` holds the ranges of the mesh in the panorama, the quality of
    each pixel, the picture (H, W, 3) and the picture without its detail. `out`, whose rows count from the start of the
    span: weight (n,), which is quality × cosine / range², 0 where the texel is hidden, seen from behind or edge-on; the
    colour without detail (n, 3), and the detail (n, 3), both bilinear.
    """
    triangle, weights = texels
    vertices, normals, faces = mesh
    ranges, quality, picture, smooth = view
    weight, base, detail = out
    height, width = ranges.shape
    pixel_rad = math.pi / height
    for texel in range(span[0], span[1]):
        at = texel - span[0]
        weight[at] = 0
        i, j, k = faces[triangle[texel], 0], faces[triangle[texel], 1], faces[triangle[texel], 2]
        of_j, of_k = weights[texel, 0], weights[texel, 1]
        of_i = 1 - of_j - of_k
        x = of_i * vertices[i, 0] + of_j * vertices[j, 0] + of_k * vertices[k, 0]
        y = of_i * vertices[i, 1] + of_j * vertices[j, 1] + of_k * vertices[k, 1]
        z = of_i * vertices[i, 2] + of_j * vertices[j, 2] + of_k * vertices[k, 2]
        nx = of_i * normals[i, 0] + of_j * normals[j, 0] + of_k * normals[k, 0]
        ny = of_i * normals[i, 1] + of_j * normals[j, 1] + of_k * normals[k, 1]
        nz = of_i * normals[i, 2] + of_j * normals[j, 2] + of_k * normals[k, 2]
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        r = math.sqrt(x * x + y * y + z * z)
        cosine = -(x * nx + y * ny + z * nz) / (r * length)
        if not cosine >= MIN_COSINE:
            continue
        px, py = pixel_from_ray(x, y, z, height, width)
        row_0, row_1, column_00, column_01, column_10, column_11, right, down = corners_at(px, py, height, width)
        nearest = min(
            min(ranges[row_0, column_00], ranges[row_0, column_01]),
            min(ranges[row_1, column_10], ranges[row_1, column_11]),
        )
        slope = SLOPE_PX * pixel_rad * math.sqrt(1 - min(cosine * cosine, 1.0)) / cosine
        if r > nearest * (1 + RANGE_TOLERANCE + slope):
            continue
        good = min(
            min(quality[row_0, column_00], quality[row_0, column_01]),
            min(quality[row_1, column_10], quality[row_1, column_11]),
        )
        if not good > 0:
            continue
        weight[at] = good * cosine / (r * r)
        for channel in range(3):
            color = bilinear(
                float(picture[row_0, column_00, channel]),
                float(picture[row_0, column_01, channel]),
                float(picture[row_1, column_10, channel]),
                float(picture[row_1, column_11, channel]),
                right,
                down,
            )
            plain = bilinear(
                smooth[row_0, column_00, channel],
                smooth[row_0, column_01, channel],
                smooth[row_1, column_10, channel],
                smooth[row_1, column_11, channel],
                right,
                down,
            )
            base[at, channel], detail[at, channel] = plain, color - plain
