"""Range maps that are known in closed form, and harm done to them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import Room, range_along

SEEN, TRUSTED = 100, 200


def as_map(ranges: NDArray[Any], confidence: int | NDArray[Any] = SEEN) -> RangeMap:
    ranges = np.asarray(ranges, np.float32)
    return RangeMap(ranges, np.where(np.isfinite(ranges), confidence, 0).astype(np.uint8))


def box_range(
    size_hw: tuple[int, int],
    half_xyz: tuple[float, float, float] = (3.0, 1.4, 2.5),
    center: tuple[float, float, float] = (0.4, -0.3, 0.2),
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Ranges from a place in an empty box, and the normal of the wall each ray meets, (H, W, 3)."""
    rays = ray_grid(size_hw)
    distances = (np.sign(rays) * half_xyz - center) / np.where(rays == 0, 1e-300, rays)
    axis = np.argmin(distances, axis=-1)[..., None]
    normals = np.zeros_like(rays)
    np.put_along_axis(normals, axis, -np.sign(np.take_along_axis(rays, axis, -1)), -1)
    return np.take_along_axis(distances, axis, -1)[..., 0].astype(np.float32), normals


def room_range(room: Room, pose: Rigid3, size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Exact ranges from a camera in the synthetic room, (H, W) float32."""
    rays = ray_grid(size_hw).reshape(-1, 3) @ pose.rotation
    return range_along(room, pose.center, rays).reshape(size_hw).astype(np.float32)


def random_map(rng: np.random.Generator, size_hw: tuple[int, int], holes: float = 0.2) -> RangeMap:
    """Ranges without any order, a share of them missing, of all confidences."""
    ranges = rng.uniform(0.5, 6, size_hw)
    ranges[rng.random(size_hw) < holes] = np.nan
    confidence = rng.integers(1, 256, size_hw)
    return as_map(ranges, confidence)


def rolled(range_map: RangeMap, columns: int) -> RangeMap:
    return RangeMap(np.roll(range_map.range, columns, 1), np.roll(range_map.confidence, columns, 1))
