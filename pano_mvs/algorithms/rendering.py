"""Pictures of clouds without a graphics library, and the viewpoints from which clouds are shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray

_OUTSIDE_AZIMUTH_RAD, _OUTSIDE_ELEVATION_RAD = np.deg2rad(35.0), np.deg2rad(42.0)
_OUTSIDE_FOV_DEG = 36.0


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """One camera of a renderer.

    `title`: description for display. `eye`: (3,) in the world. `target`: (3,) in the world, in the middle of the
    picture. `up`: (3,) unit vector in the world, upwards in the picture. `fov_deg`: vertical field of view; 0 for a
    parallel projection. `height`: height of the view of a parallel projection, in scene units; 0 for a perspective one.
    """

    title: str
    eye: FloatArray
    target: FloatArray
    up: FloatArray
    fov_deg: float = 0.0
    height: float = 0.0


def viewpoints(
    points_in_world: NDArray[np.float32], centers: FloatArray, up: FloatArray, *, aspect: float, place: str = ""
) -> tuple[Viewpoint, ...]:
    """Return three viewpoints of a cloud: above, outside, inside.

    `points_in_world`: (N, 3), N > 0. `centers`: (M, 3) of the cameras; M may be 0. `up`: (3,) unit vector away from the
    ground. `aspect`: width over height of the pictures. `place`: name of the camera that shows the inside, for the
    title; see `inside_camera`.
    """
    right, forward = horizontal_axes(up)
    level = np.asarray(points_in_world, np.float64) @ np.stack([right, up, forward], axis=1)
    low, high = np.quantile(level, [0.01, 0.99], axis=0)
    middle = (low + high) / 2 @ np.stack([right, up, forward])
    extent = np.maximum(high - low, 1e-6 * (1 + np.abs(middle).max()))
    radius = float(np.linalg.norm(extent)) / 2
    height = float(max(extent[2], extent[0] / aspect)) * 1.06
    above = Viewpoint("From above", middle + up * 3 * radius, middle, forward, height=height)
    flat = -np.cos(_OUTSIDE_AZIMUTH_RAD) * forward + np.sin(_OUTSIDE_AZIMUTH_RAD) * right
    towards = np.cos(_OUTSIDE_ELEVATION_RAD) * flat + np.sin(_OUTSIDE_ELEVATION_RAD) * up
    distance = 0.92 * radius / np.tan(np.deg2rad(_OUTSIDE_FOV_DEG) / 2)
    outside = Viewpoint("From outside", middle + towards * distance, middle, up, fov_deg=_OUTSIDE_FOV_DEG)
    return above, outside, _inside(centers, middle, up, place=place)


def inside_camera(centers: FloatArray) -> int:
    """Return the index of the camera that is farthest from the median of all centres."""
    return int(np.argmax(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))


def horizontal_axes(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors perpendicular to `up`: to the right, and forward (along z as far as possible)."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    forward = axis - (axis @ up) * up
    forward /= np.linalg.norm(forward)
    return np.cross(forward, up), forward


def facing(points: NDArray[np.float32], normals: NDArray[np.float32], viewpoint: Viewpoint) -> NDArray[np.bool_]:
    """Return the points (N,) that show their front, so that no ceiling or wall hides the inside of a room."""
    if viewpoint.height:
        towards = np.broadcast_to((viewpoint.eye - viewpoint.target).astype(np.float32), points.shape)
    else:
        towards = viewpoint.eye.astype(np.float32) - points
    length = np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
    # Cosine: surfaces seen nearly edge-on stay, because noisy normals would tear them.
    shown: NDArray[np.bool_] = np.einsum("ni,ni->n", towards, normals) >= -0.05 * length
    return shown


def _inside(centers: FloatArray, middle: FloatArray, up: FloatArray, *, place: str) -> Viewpoint:
    """Return the view from the outermost camera towards the others; forward if there is only one camera."""
    eye = centers[inside_camera(centers)] if len(centers) else middle
    _, forward = horizontal_axes(up)
    towards = (np.median(centers, axis=0) if len(centers) else middle) - eye
    towards = towards - (towards @ up) * up
    length = float(np.linalg.norm(towards))
    direction = towards / length if length > 1e-6 * (1 + float(np.abs(eye).max())) else forward
    title = f"From inside, where {place} was taken" if place else "From inside"
    return Viewpoint(title, eye, eye + direction, up, fov_deg=90.0)


_PAPER = (238, 241, 244)


def draw_cloud(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    colors_rgb: NDArray[np.uint8],
    *,
    viewpoint: Viewpoint,
    size_hw: tuple[int, int],
) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) RGB of a cloud; points are squares, larger if there are fewer points.

    `points`: (N, 3) in the world. `normals`: (N, 3) in the world; points seen from behind are not drawn. `colors_rgb`:
    (N, 3) uint8. `viewpoint`: the camera of the image. `size_hw`: (height, width) of the image.
    """
    shown = facing(points, normals, viewpoint)
    x, y, depth = _projected(points[shown].astype(np.float64), viewpoint, size_hw)
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    inside = (depth > 0) & (column >= 0) & (column < size_hw[1]) & (row >= 0) & (row < size_hw[0])
    pixel = (row * size_hw[1] + column)[inside]
    # Far points first: of several writes to a pixel, the last one stays.
    order = np.argsort(-depth[inside], kind="stable")
    image = np.full((size_hw[0] * size_hw[1], 3), _PAPER, np.uint8)
    side = int(np.clip(np.sqrt(image.shape[0] / max(1, len(pixel))) * 2, 1, 5))
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
