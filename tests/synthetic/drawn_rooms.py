"""Pictures of drawn rooms with a floor, a ceiling, and four walls with a window each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import ray_grid, rotation_from_rotvec
from pano_mvs.scene.rooms import OUTLINE_AZIMUTHS

SIZE_HW = (256, 512)
COLORS = np.array([[150, 110, 70], [235, 235, 230], [205, 200, 190], [180, 190, 200], [190, 205, 185], [215, 195, 185]])
TILT = rotation_from_rotvec(np.radians([1.2, 0.0, -0.8]))  # cam_from_level


def box(turn_deg: float = 25.0, ceiling: float = 0.7, walls: tuple[float, ...] = (1.4, 2.2, 1.9, 1.1), *,
        cam_from_level: NDArray[np.float64] = TILT) -> NDArray[np.uint8]:  # fmt: skip
    """Return the picture of a room with a window in each wall; walls are at distances in heights of the camera."""
    rays = ray_grid(SIZE_HW) @ cam_from_level
    ranges = [np.where(sign * rays[..., 1] > 0, height / np.abs(rays[..., 1]), np.inf)
              for sign, height in ((1, 1.0), (-1, ceiling))]  # fmt: skip
    for number, distance in enumerate(walls):
        azimuth = np.radians(turn_deg + 90 * number)
        cosine = rays @ [np.sin(azimuth), 0.0, np.cos(azimuth)]
        with np.errstate(divide="ignore"):
            ranges.append(np.where(cosine > 0, distance / cosine, np.inf))
    seen = np.argmin(ranges, axis=0)
    shown = COLORS[seen].astype(np.float64)
    points = rays * np.min(ranges, axis=0)[..., None]
    for number in range(4):
        azimuth = np.radians(turn_deg + 90 * number)
        along = points @ [np.cos(azimuth), 0.0, -np.sin(azimuth)]
        window = (seen == number + 2) & (np.abs(along + 0.2) < 0.4) & (np.abs(points[..., 1]) < 0.3)
        shown[window] -= 60.0
    shown += np.random.default_rng(0).normal(0, 1.5, (*SIZE_HW, 1))
    return np.asarray(shown.clip(0, 255).round(), np.uint8)


def true_distances(turn_deg: float = 25.0, walls: tuple[float, ...] = (1.4, 2.2, 1.9, 1.1)) -> NDArray[np.float64]:
    azimuths = np.radians(np.arange(OUTLINE_AZIMUTHS)[:, None] - turn_deg - 90 * np.arange(4))
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(np.cos(azimuths) > 0, np.array(walls) / np.cos(azimuths), np.inf).min(axis=1))
