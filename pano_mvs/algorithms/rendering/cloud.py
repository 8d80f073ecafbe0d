"""Render a cloud as points with a depth buffer, without a graphics library."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering.viewpoints import Viewpoint, facing

_PAPER = (238, 241, 244)
_MAX_POINT_PX = 5


def draw_cloud(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    colors_rgb: NDArray[np.uint8],
    *,
    viewpoint: Viewpoint,
    size_hw: tuple[int, int],
) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) RGB of a cloud; points are squares, larger if there are fewer points.

    Args:
        points: (N, 3) in the world.
        normals: (N, 3) in the world; points seen from behind are not drawn.
        colors_rgb: (N, 3) uint8.
        viewpoint: the camera of the image.
        size_hw: (height, width) of the image.
    """
    shown = facing(points, normals, viewpoint)
    x, y, depth = _projected(points[shown].astype(np.float64), viewpoint, size_hw)
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    inside = (depth > 0) & (column >= 0) & (column < size_hw[1]) & (row >= 0) & (row < size_hw[0])
    pixel = (row * size_hw[1] + column)[inside]
    # Far points first: of several writes to a pixel, the last one stays.
    order = np.argsort(-depth[inside], kind="stable")
    image = np.full((size_hw[0] * size_hw[1], 3), _PAPER, np.uint8)
    side = int(np.clip(np.sqrt(image.shape[0] / max(1, len(pixel))) * 2, 1, _MAX_POINT_PX))
    nearest = np.full(image.shape[0], np.inf)
    nearest[pixel[order]] = depth[inside][order]
    image[pixel[order]] = colors_rgb[shown][inside][order]
    return _spread(image.reshape(*size_hw, 3), nearest.reshape(size_hw), side)


def _projected(
    points: NDArray[np.float64], viewpoint: Viewpoint, size_hw: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return x, y in pixels and the depth of points; points behind the eye have depth 0."""
    height, width = size_hw
    ahead = viewpoint.target - viewpoint.eye
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, viewpoint.up)
    right = right / np.linalg.norm(right)
    above = np.cross(right, ahead)
    across, upwards, depth = ((points - viewpoint.eye) @ np.stack([right, above, ahead], axis=1)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        if viewpoint.height:
            scale = np.full(len(points), height / viewpoint.height)
        else:
            scale = height / 2 / np.tan(np.deg2rad(viewpoint.fov_deg) / 2) / depth
        x, y = width / 2 + across * scale, height / 2 - upwards * scale
    valid = (depth > 0) & np.isfinite(x) & np.isfinite(y)
    limit = 10.0 * (width + height)
    return (
        np.where(valid, x, -1.0).clip(-limit, limit),
        np.where(valid, y, -1.0).clip(-limit, limit),
        np.where(valid, depth, 0.0),
    )


def _spread(image: NDArray[np.uint8], nearest: NDArray[np.float64], side: int) -> NDArray[np.uint8]:
    """Let each drawn pixel cover a square, nearer ones over farther ones."""
    result, front = image.copy(), nearest.copy()
    rows, columns = np.nonzero(np.isfinite(nearest))
    depths, colors = nearest[rows, columns], image[rows, columns]
    for down in range(side):
        for along in range(side):
            inside = (rows + down < nearest.shape[0]) & (columns + along < nearest.shape[1])
            below, right = rows[inside] + down, columns[inside] + along
            nearer = depths[inside] < front[below, right]
            below, right = below[nearer], right[nearer]
            front[below, right] = depths[inside][nearer]
            result[below, right] = colors[inside][nearer]
    return result
