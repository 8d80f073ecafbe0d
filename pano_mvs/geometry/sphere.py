"""The equirectangular camera: pixels to unit rays and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError

UP = np.array([0.0, -1.0, 0.0])
"""Up in the frame of a level camera and in a levelled world: y points down."""


def ray_from_pixel(pixels_px: ArrayLike, size_hw: tuple[int, int]) -> FloatArray:
    """Return the unit rays through pixels of a full equirectangular panorama.

    θ = 2π (x / w − ½), φ = π (½ − y / h), ray = (cos φ sin θ, −sin φ, cos φ cos θ).

    Args:
        pixels_px: (..., 2) positions (x, y) in pixels, (0, 0) the upper-left corner of the picture.
        size_hw: (height, width) of the picture in pixels.

    Returns:
        (..., 3) unit vectors in the camera frame (x right, y down, z forward).

    >>> ray_from_pixel([[512, 256], [768, 256]], (512, 1024)).round(6) + 0.0  # forward, right
    array([[0., 0., 1.],
           [1., 0., 0.]])
    """
    pixels = np.asarray(pixels_px, dtype=np.float64)
    height, width = _checked_size(size_hw)
    azimuth = 2 * np.pi * (pixels[..., 0] / width - 0.5)
    elevation = np.pi * (0.5 - pixels[..., 1] / height)
    cos_elevation = np.cos(elevation)
    return np.stack([cos_elevation * np.sin(azimuth), -np.sin(elevation), cos_elevation * np.cos(azimuth)], axis=-1)


def pixel_from_ray(rays: ArrayLike, size_hw: tuple[int, int]) -> FloatArray:
    """Return the pixel of a full equirectangular panorama in which each ray arrives.

    Args:
        rays: (..., 3) vectors in the camera frame, of any length but zero.
        size_hw: (height, width) of the picture in pixels.

    Returns:
        (..., 2) positions (x, y), x in [0, w], y in [0, h]. The azimuth of a pole is arbitrary.

    >>> pixel_from_ray([0, 1, 1], (512, 1024)).tolist()  # 45° below the horizon
    [512.0, 384.0]
    """
    vectors = np.asarray(rays, dtype=np.float64)
    height, width = _checked_size(size_hw)
    azimuth = np.arctan2(vectors[..., 0], vectors[..., 2])
    elevation = np.arctan2(-vectors[..., 1], np.hypot(vectors[..., 0], vectors[..., 2]))
    return np.stack([(azimuth / (2 * np.pi) + 0.5) * width, (0.5 - elevation / np.pi) * height], axis=-1)


def ray_grid(size_hw: tuple[int, int], rows: slice = slice(None)) -> FloatArray:
    """Return the unit rays through all pixel centres, (height, width, 3), in the camera frame; of some rows if given.

    >>> ray_grid((512, 1024)).shape
    (512, 1024, 3)
    """
    # One row and one column are enough: nothing as large as the result is made beside it.
    turns, elevations = sines_of_grid(size_hw)
    elevations = elevations[:, rows]
    rays = np.empty((elevations.shape[1], turns.shape[1], 3))
    rays[..., 0] = elevations[1][:, None] * turns[0]
    rays[..., 1] = -elevations[0][:, None]
    rays[..., 2] = elevations[1][:, None] * turns[1]
    return rays


def sines_of_grid(size_hw: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return sin θ and cos θ of the columns, (2, width), and sin φ and cos φ of the rows, (2, height).

    The ray through a pixel centre is (cos φ sin θ, −sin φ, cos φ cos θ).
    """
    height, width = _checked_size(size_hw)
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    return np.stack([np.sin(azimuth), np.cos(azimuth)]), np.stack([np.sin(elevation), np.cos(elevation)])


def spiral_rays(count: int) -> FloatArray:
    """Return evenly spread unit rays, (count, 3): Fibonacci's spiral (Swinbank & Purser 2006)."""
    y = 1 - (2 * np.arange(count) + 1) / count
    azimuth = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - y**2)
    return np.stack([flat * np.sin(azimuth), y, flat * np.cos(azimuth)], axis=-1)


def pixel_solid_angle(size_hw: tuple[int, int]) -> FloatArray:
    """Return the exact solid angle of a pixel in each row, (height,), in steradians; all pixels sum to 4π."""
    height, width = _checked_size(size_hw)
    edges = np.sin(np.pi * (0.5 - np.arange(height + 1) / height))
    return (edges[:-1] - edges[1:]) * (2 * np.pi / width)


def angle_between(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Return the angle between vectors, (...,), in radians in [0, π], exact for small and for large angles.

    Kahan's form 2 atan2(|a/|a| − b/|b||, |a/|a| + b/|b||), which loses no digits where acos does.
    """
    a = np.asarray(first, dtype=np.float64)
    b = np.asarray(second, dtype=np.float64)
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    angle: FloatArray = 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return angle


def _checked_size(size_hw: tuple[int, int]) -> tuple[int, int]:
    height, width = size_hw
    if height < 1 or width < 1:
        raise UsageError(f"a picture of {width}×{height} pixels has no pixels: give (height, width), both positive")
    return height, width
