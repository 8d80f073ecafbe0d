"""Arrays as the short texts that the page decodes."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.algorithms.points.octree import OctreeNode
from pano_mvs.scene import PointCloud
from pano_mvs_page.mesh_file import SharedMesh

_LEVELS = 65535


@dataclass(frozen=True, eq=False)
class LogSteps:
    """Positive values as whole steps of their logarithm."""

    # of the shape of the values; 0 where there is none, 1 for `low`, the largest step for `high`
    steps: NDArray[np.unsignedinteger]
    low: float  # the smallest value
    high: float  # the largest value, always more than `low`


def log_steps(values: ArrayLike, dtype: type[np.uint8 | np.uint16]) -> LogSteps:
    """Return values in logarithmic steps; values that are not finite and positive become step 0."""
    given = np.asarray(values, np.float64)
    steps = np.zeros(given.shape, dtype)
    valid = np.isfinite(given) & (given > 0)
    if not valid.any():
        return LogSteps(steps, 1.0, 2.0)
    low, high = float(given[valid].min()), float(given[valid].max()) * (1 + 1e-6)
    position = np.log(given[valid] / low) / np.log(high / low)
    steps[valid] = 1 + np.rint(position * (np.iinfo(dtype).max - 1)).astype(dtype)
    return LogSteps(steps, low, high)


def encode_points(node: OctreeNode, cloud: PointCloud, sigma_steps: NDArray[np.unsignedinteger]) -> str:
    """Return the points of a node as base64, one array after the other.

    The arrays are places within the cube (K, 3) uint16, colours (K, 3) uint8, view counts (K,) uint8, normals
    (K, 3) int8, and steps of the standard deviation (K,) uint8.

    Args:
        node: of the octree.
        cloud: the whole cloud, in the frame of the octree.
        sigma_steps: (N,) uint8 for all points of the cloud; 0 where the standard deviation is unknown.
    """
    chosen = node.chosen
    places = quantised(cloud.points_in_world[chosen], node.lower, node.size)
    normals = np.rint(cloud.normals_in_world[chosen] * 127).clip(-127, 127).astype(np.int8)
    return encode_arrays(places, cloud.colors_rgb[chosen], cloud.view_counts[chosen], normals, sigma_steps[chosen])


def quantised(points: NDArray[np.float32], lower: NDArray[np.float64], size: float) -> NDArray[np.uint16]:
    """Return places within a cube, (K, 3), where 65535 stands for its far side."""
    return np.rint((points - lower) / size * _LEVELS).clip(0, _LEVELS).astype("<u2")


def encode_arrays(*parts: NDArray[np.generic]) -> str:
    """Return arrays, one after the other, as base64."""
    return base64.b64encode(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).decode("ascii")


def encode_ranges(ranges: NDArray[np.float32]) -> tuple[str, float, float]:
    """Return ranges as base64 of uint16 in logarithmic steps, and the smallest and the largest range.

    Step 0 stands for no range. The steps are below 0.01 % of the range for ranges that differ by a factor of up to 500.
    """
    encoded = log_steps(ranges, np.uint16)
    return encode_arrays(encoded.steps.astype("<u2")), encoded.low, encoded.high


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> str:
    """Return an RGB image as the base64 of a JPEG file."""
    data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return base64.b64encode(data.tobytes()).decode("ascii")


def encode_webp(image: NDArray[np.uint8]) -> str:
    """Return an RGB or RGBA image as the base64 of a WebP file."""
    swapped = cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    data = cv2.imencode(".webp", cv2.cvtColor(image, swapped), [cv2.IMWRITE_WEBP_QUALITY, 85])[1]
    return base64.b64encode(data.tobytes()).decode("ascii")


PIECE_FACES = 20_000
"""Largest number of triangles of a piece; even if no two share a corner, two bytes count its vertices."""

_Z_BITS = 10


@dataclass(frozen=True, eq=False)
class VertexFacts:
    """What the page knows of vertices besides their place and colour."""

    sigma_steps: NDArray[np.uint8]  # (V,) uint8 steps of the standard deviation of the position; 0 if unknown
    view_counts: NDArray[np.uint8]  # (V,) uint8 number of views that agree on the surface there


def mesh_pieces(mesh: SharedMesh, facts: VertexFacts) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the pieces of a mesh: what the page needs to know of it, and its arrays as base64.

    The arrays are places within a cube (V, 3) uint16, places in the texture (V, 2) uint16 if there is one, corners
    (F, 3) uint16, colours (V, 3) uint8 if there is no texture, steps of the standard deviation (V,) uint8 and view
    counts (V,) uint8.
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


TILE = 1024
"""Largest width of a tile in pixels: level 0 is one tile, level L is 2^L columns by 2^(L-1) rows of the same width."""


def tile_layout(width: int, max_width: int) -> tuple[int, int]:
    """Return how many levels a panorama has, and the width of its tiles: those of the last level make up its width."""
    full = max(TILE, min(width, max_width))
    levels = math.ceil(math.log2(full / TILE)) + 1
    return levels, 2 * round(full / (1 << levels))


def panorama_tiles(
    image: NDArray[np.uint8], levels: int, tile_width: int
) -> Iterator[tuple[int, int, int, NDArray[np.uint8]]]:
    """Yield (level, column, row, pixels) of all tiles."""
    for level in range(levels):
        width, height = tile_width << level, tile_width << level >> 1
        shrinks = width < image.shape[1]
        scaled = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        rows = max(1, 1 << level >> 1)
        for row in range(rows):
            for column in range(1 << level):
                tile = scaled[
                    row * height // rows : (row + 1) * height // rows, column * tile_width : (column + 1) * tile_width
                ]
                yield level, column, row, np.asarray(tile, np.uint8)
