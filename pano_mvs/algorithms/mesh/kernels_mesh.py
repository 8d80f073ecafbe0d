"""Compiled: triangles drawn into panoramas and texture charts, and the colours a panorama gives to texels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray, FloatImage
from pano_mvs.core.kernels import inlined, kernel
from pano_mvs.geometry.kernels_sphere import bilinear, corners_at, fast_azimuth, fast_dip, pixel_from_ray

Vector = tuple[float, float, float]
Targets = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]

_EDGE = 1e-9  # a ray through the common edge of two triangles meets both
_MARGIN_PX = 1.0
_DEGENERATE = 1e-12


@inlined
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _pixel_bounds(a: Vector, b: Vector, c: Vector, height: int, width: int) -> tuple[int, int, int, int]:
    """Return rows [first, end) and columns [first, end) that contain a spherical triangle; columns are not wrapped.

    The triangle lies in the cap around the mean of its corners' directions that contains the corners.
    """
    lengths = (math.sqrt(_dot(a, a)), math.sqrt(_dot(b, b)), math.sqrt(_dot(c, c)))
    x = a[0] / lengths[0] + b[0] / lengths[1] + c[0] / lengths[2]
    y = a[1] / lengths[0] + b[1] / lengths[1] + c[1] / lengths[2]
    z = a[2] / lengths[0] + b[2] / lengths[1] + c[2] / lengths[2]
    length = math.sqrt(x * x + y * y + z * z)
    if length < 0.3:  # seen from within its plane, nearly: the cap is more than a hemisphere
        return 0, height, 0, width
    x, y, z = x / length, y / length, z / length
    cosine = 1.0
    for k in range(3):
        corner = a if k == 0 else b if k == 1 else c
        cosine = min(cosine, (corner[0] * x + corner[1] * y + corner[2] * z) / lengths[k])
    radius = math.acos(min(max(cosine, -1.0), 1.0))
    elevation = math.asin(min(max(-y, -1.0), 1.0))
    px = height / math.pi
    first_row = max(0, math.floor((0.5 * math.pi - elevation - radius) * px - _MARGIN_PX))
    end_row = min(height, math.ceil((0.5 * math.pi - elevation + radius) * px + _MARGIN_PX))
    if abs(elevation) + radius > 0.5 * math.pi - 0.5 / px:
        return first_row, end_row, 0, width
    half = math.asin(min(1.0, math.sin(radius) / math.cos(elevation)))
    azimuth = math.atan2(x, z) + math.pi
    first_column = math.floor((azimuth - half) * px - _MARGIN_PX)
    end_column = math.ceil((azimuth + half) * px + _MARGIN_PX)
    if end_column - first_column >= width:
        return first_row, end_row, 0, width
    return first_row, end_row, first_column, end_column


@kernel
def pixel_bounds(corners: FloatArray, size: tuple[int, int], bounds: NDArray[np.int32]) -> None:
    """Write the bounds of triangles (F, 3, 3) in camera coordinates: rows and columns [first, end), (F, 4).

    A triangle that the camera sees edge-on, or with a corner in the camera, gets no rows.
    """
    height, width = size
    for face in range(len(corners)):
        v = corners[face]
        a, b, c = (v[0, 0], v[0, 1], v[0, 2]), (v[1, 0], v[1, 1], v[1, 2]), (v[2, 0], v[2, 1], v[2, 2])
        volume = _dot(a, _cross(b, c))
        scale = _dot(a, a) * _dot(b, b) * _dot(c, c)
        if not volume * volume > _DEGENERATE**2 * scale:
            bounds[face] = 0
            continue
        bounds[face, 0], bounds[face, 1], bounds[face, 2], bounds[face, 3] = _pixel_bounds(a, b, c, height, width)


@kernel
def draw_triangles(
    corners: FloatArray,
    bounds: NDArray[np.int32],
    directions: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    rows: tuple[int, int],
    targets: Targets,
) -> None:
    """Draw triangles into the rows [first, end) of an equirectangular picture, nearest first.

    `corners` (F, 3, 3) are in camera coordinates, with the bounds of `pixel_bounds`. `directions` holds the cosine and
    sine of the elevation of each row, and of the azimuth of each column. `targets` changes in place: ranges (H, W),
    infinite where there is nothing yet, the index of the triangle, and the weights (H, W, 2) of its second and third
    corner. Of two triangles at the same range, the earlier one stays.
    """
    cos_row, sin_row, cos_column, sin_column = directions
    ranges, triangle, weights = targets
    width = ranges.shape[1]
    for face in range(len(corners)):
        first, end = max(rows[0], bounds[face, 0]), min(rows[1], bounds[face, 1])
        if first >= end:
            continue
        v = corners[face]
        a, b, c = (v[0, 0], v[0, 1], v[0, 2]), (v[1, 0], v[1, 1], v[1, 2]), (v[2, 0], v[2, 1], v[2, 2])
        of_a, of_b, of_c = _cross(b, c), _cross(c, a), _cross(a, b)
        volume = _dot(a, of_a)
        sign = 1.0 if volume > 0 else -1.0
        for row in range(first, end):
            level, down = cos_row[row], -sin_row[row]
            for unwrapped in range(bounds[face, 2], bounds[face, 3]):
                column = unwrapped % width
                ray = (level * sin_column[column], down, level * cos_column[column])
                e_a, e_b, e_c = sign * _dot(of_a, ray), sign * _dot(of_b, ray), sign * _dot(of_c, ray)
                total = e_a + e_b + e_c
                least = -_EDGE * total
                if total <= 0 or e_a < least or e_b < least or e_c < least:
                    continue
                distance = np.float32(sign * volume / total)
                if distance < ranges[row, column]:
                    ranges[row, column] = distance
                    triangle[row, column] = face
                    weights[row, column, 0], weights[row, column, 1] = e_b / total, e_c / total


@kernel
def draw_charts(uv_px: FloatArray, triangle: NDArray[np.int32], weights: NDArray[np.float32]) -> None:
    """Write to each texel the triangle that contains its centre, and the weights of its second and third corner.

    `uv_px` (F, 3, 2) are positions (x, y) in texels; `triangle` (H, W) is −1 where there is none yet.
    """
    height, width = triangle.shape
    for face in range(len(uv_px)):
        v = uv_px[face]
        ax, ay, bx, by, cx, cy = v[0, 0], v[0, 1], v[1, 0], v[1, 1], v[2, 0], v[2, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < _DEGENERATE:
            continue
        first_row = max(0, math.floor(min(ay, by, cy) - 0.5))
        end_row = min(height, math.ceil(max(ay, by, cy) + 0.5))
        first_column = max(0, math.floor(min(ax, bx, cx) - 0.5))
        end_column = min(width, math.ceil(max(ax, bx, cx) + 0.5))
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                if triangle[row, column] >= 0:
                    continue
                x, y = column + 0.5, row + 0.5
                of_b = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                of_c = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                if of_b >= -_EDGE and of_c >= -_EDGE and of_b + of_c <= 1 + _EDGE:
                    triangle[row, column] = face
                    weights[row, column, 0], weights[row, column, 1] = of_b, of_c


Grid = tuple[FloatArray, float, float]
Measured = tuple[FloatImage, FloatImage, FloatImage, FloatImage, FloatImage]


@kernel
def add_distances(
    grid: Grid, pose: FloatArray, view: Measured, span: tuple[int, int], out: tuple[FloatImage, FloatImage, FloatImage]
) -> None:
    """Add the signed distances that a panorama measured to the cells [first, end) of a grid.

    `grid` holds the centre of the first cell, the width of the cells, and the distance from the surface within which a
    panorama measures. `pose` is cam_from_world (3, 4). `view` holds for each pixel its range, the least range around,
    its weight, 0 without a range, how much it counts as support, and its plane (H, W, 4), normal and offset in camera
    coordinates. `out` are the mean distances (X, Y, Z), the sums of the weights, and the support by panoramas that
    measured a surface here less that by panoramas that see something farther away. Weights are half as large again just
    behind a surface and fall to 0, so that a layer of cells remains of a board that is seen from both sides.
    """
    origin, cell, limit = grid
    ranges, nearest, weights, worth, planes = view
    distances, totals, support = out
    height, width = ranges.shape
    for i in range(span[0], span[1]):
        world_x = origin[0] + cell * i
        for j in range(distances.shape[1]):
            world_y = origin[1] + cell * j
            start_x = pose[0, 0] * world_x + pose[0, 1] * world_y + pose[0, 3]
            start_y = pose[1, 0] * world_x + pose[1, 1] * world_y + pose[1, 3]
            start_z = pose[2, 0] * world_x + pose[2, 1] * world_y + pose[2, 3]
            for k in range(distances.shape[2]):
                world_z = origin[2] + cell * k
                x, y, z = start_x + pose[0, 2] * world_z, start_y + pose[1, 2] * world_z, start_z + pose[2, 2] * world_z
                level = np.float32(math.sqrt(x * x + z * z))
                column = math.floor((fast_azimuth(np.float32(x), np.float32(z)) / (2 * math.pi) + 0.5) * width)
                row = math.floor((0.5 + fast_dip(np.float32(y), level) / math.pi) * height)
                row, column = min(max(row, 0), height - 1), column % width
                weight = weights[row, column]
                if not weight > 0:
                    continue
                r = math.sqrt(x * x + y * y + z * z)
                along = ranges[row, column] - r
                if along < -8 * limit:
                    continue
                distance = planes[row, column, 0] * x + planes[row, column, 1] * y + planes[row, column, 2] * z
                distance -= planes[row, column, 3]
                if abs(along) < abs(distance):
                    distance = along
                if distance <= -limit:
                    continue
                if distance > limit:
                    if nearest[row, column] - r > limit:
                        support[i, j, k] -= worth[row, column]
                    continue
                share = 1.0 if distance >= 0 else 1.5 + 1.5 * distance / limit
                support[i, j, k] += worth[row, column]
                total = totals[i, j, k] + weight * share
                distances[i, j, k] += (distance - distances[i, j, k]) * weight * share / total
                totals[i, j, k] = total


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

    `texels` holds the triangle and the weights of its second and third corner; `mesh` the vertices (V, 3) and the unit
    normals (F, 3) of the triangles in camera coordinates, and the triangles. `view` holds the ranges of the mesh in the
    panorama, the quality of each pixel, the picture (H, W, 3) and the picture without its detail. `out`, whose rows
    count from the start of the span: weight (n,), which is quality × cosine / range², 0 where the texel is hidden, seen
    from behind or edge-on; the colour without detail (n, 3), and the detail (n, 3), both bilinear.
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
        r = math.sqrt(x * x + y * y + z * z)
        normal = normals[triangle[texel]]
        cosine = -(x * normal[0] + y * normal[1] + z * normal[2]) / r
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
