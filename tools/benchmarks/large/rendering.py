"""Panoramas of thousands of painted boxes, drawn by compiled loops, which are quick at 2048 columns and more.

A pixel takes about a microsecond. Nothing is smooth but the sky; every box has a pattern of its own, which fades where
a pixel covers more than its grain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, ray_grid

_SKY = np.array([(0.85, 0.9, 0.95), (0.35, 0.55, 0.85)])
_NOISE = 1.0
_ROWS = 256


@dataclass(frozen=True)
class Boxes:
    """Axis-aligned boxes in a world with y down.

    Attributes:
        low, high: corners (N, 3).
        colors_rgb: (N, 3) in [0, 1].
        windows: (N, 2) width and height of the fields of a facade; 0 for none.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    colors_rgb: NDArray[np.float64]
    windows: NDArray[np.float64]


def draw(
    boxes: Boxes, cam_from_world: Rigid3, size_hw: tuple[int, int], *, reach: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the panorama (H, W, 3) uint8 RGB of a camera, with sensor noise, and its ranges (H, W), NaN for the sky.

    Args:
        boxes: of the place. The camera may be inside a box, whose inner side it then sees.
        cam_from_world: pose.
        size_hw: of the panorama.
        reach: distance in scene units beyond which boxes are left out.
    """
    center = cam_from_world.center
    gaps = np.maximum(np.maximum(boxes.low - center, center - boxes.high), 0)
    near = np.flatnonzero(np.linalg.norm(gaps, axis=1) < reach)
    near = near[np.argsort(np.linalg.norm(gaps[near], axis=1), kind="stable")]
    shapes = boxes.low[near], boxes.high[near], gaps[near]
    looks = near, boxes.colors_rgb[near], boxes.windows[near]
    image, ranges = np.empty((*size_hw, 3), np.uint8), np.empty(size_hw, np.float32)
    rng = np.random.default_rng(np.abs(1e6 * center).astype(np.int64))
    for first in range(0, size_hw[0], _ROWS):
        rows = slice(first, min(first + _ROWS, size_hw[0]))
        rays = np.ascontiguousarray(ray_grid(size_hw, rows) @ cam_from_world.rotation)
        colors, ranges[rows] = _traced(rays, center, shapes, looks, 2 * math.pi / size_hw[1])
        noise = rng.standard_normal(colors.shape, np.float32)
        image[rows] = np.clip(np.rint(255 * colors + _NOISE * noise), 0, 255)
    return image, ranges


def _compiled(function: Any) -> Any:
    return numba.njit(cache=True, fastmath=True)(function)


@_compiled
def _hash(a: int, b: int, c: int, seed: int) -> float:  # to [0, 1)
    mixed = (a * 73856093) ^ (b * 19349663) ^ (c * 83492791) ^ (seed * 2654435761)
    mixed = (mixed ^ (mixed >> 13)) * 1274126177 & 0x7FFFFFFF
    return ((mixed ^ (mixed >> 16)) & 0xFFFFFF) / 16777216.0


@_compiled
def _grain(u: float, v: float, face: int, seed: int) -> Any:  # smooth noise of unit wavelength in [0, 1)
    cell_u, cell_v = math.floor(u), math.floor(v)
    share_u, share_v = u - cell_u, v - cell_v
    share_u, share_v = share_u * share_u * (3 - 2 * share_u), share_v * share_v * (3 - 2 * share_v)
    row, column = int(cell_u), int(cell_v)
    above = _hash(row, column, face, seed) * (1 - share_v) + _hash(row, column + 1, face, seed) * share_v
    below = _hash(row + 1, column, face, seed) * (1 - share_v) + _hash(row + 1, column + 1, face, seed) * share_v
    return above * (1 - share_u) + below * share_u


@_compiled
def _pattern(u: float, v: float, face: int, seed: int, footprint: float, windows: Any) -> float:
    """Return the brightness of a place on a face: four octaves of grain, and windows of different brightness."""
    value, wavelength, weight = 0.5, 1.6, 0.5
    for octave in range(5):
        fade = min(1.0, max(0.0, wavelength / (2 * footprint) - 0.5))
        if fade > 0:
            value += fade * weight * (_grain(u / wavelength, v / wavelength, face, seed + octave) - 0.5)
        wavelength *= 0.37
        weight *= 0.85
    if windows[0] > 0 and face != 1:
        across, up = u / windows[0], v / windows[1]
        inside_u, inside_v = across - math.floor(across), up - math.floor(up)
        column, row = math.floor(across), math.floor(up)
        pick = _hash(column, row, face, seed + 9)
        if 0.2 < inside_u < 0.55 + 0.3 * pick and 0.25 < inside_v < 0.85:
            value = 0.25 * value + 0.6 * _hash(column, row, face, seed + 11)
    return value


@_compiled
def _traced(rays: Any, center: Any, shapes: Any, looks: Any, pixel_rad: float) -> Any:
    lows, highs, gaps = shapes
    seeds, colors, windows = looks
    height, width = rays.shape[:2]
    image, ranges = np.empty((height, width, 3), np.float32), np.full((height, width), np.nan, np.float32)
    for row in range(height):
        for column in range(width):
            ray = rays[row, column]
            best, hit, axis = 1e30, -1, 0
            for idx in range(len(lows)):
                gap = gaps[idx]
                if gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2] > best * best:
                    break
                near, far, near_axis, far_axis = -1e30, 1e30, 0, 0
                for k in range(3):
                    inverse = 1.0 / ray[k] if abs(ray[k]) > 1e-12 else 1e12
                    to_low, to_high = (lows[idx, k] - center[k]) * inverse, (highs[idx, k] - center[k]) * inverse
                    if to_low > to_high:
                        to_low, to_high = to_high, to_low
                    if to_low > near:
                        near, near_axis = to_low, k
                    if to_high < far:
                        far, far_axis = to_high, k
                if near > far or far <= 0:
                    continue
                distance, at = (near, near_axis) if near > 0 else (far, far_axis)
                if distance < best:
                    best, hit, axis = distance, idx, at
            if hit < 0:
                high = min(1.0, max(0.0, -ray[1]))
                for k in range(3):
                    image[row, column, k] = _SKY[0, k] + high * (_SKY[1, k] - _SKY[0, k])
                continue
            ranges[row, column] = best
            slant = max(0.05, abs(ray[axis]))
            across = 2 if axis == 0 else 0
            up = 2 if axis == 1 else 1
            place_u, place_v = center[across] + best * ray[across], center[up] + best * ray[up]
            side = axis if ray[axis] > 0 else axis + 3
            face = 1 if axis == 1 else side + 2
            value = _pattern(place_u, place_v, face, seeds[hit], best * pixel_rad / math.sqrt(slant), windows[hit])
            light = 0.75 + 0.25 * (1 if side == 4 else 0.5 if axis == 0 else 0.1)
            for k in range(3):
                image[row, column, k] = min(1.0, max(0.0, 1.3 * light * colors[hit, k] * value))
    return image, ranges
