"""Frames of a camera that moves through a room, for tests of keyframes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pano_mvs_video.keyframes import REDUCED_HW, GreyImage, SmallFrame
from scipy.ndimage import gaussian_filter

from pano_mvs.geometry import ray_grid, rotate_panorama, rotation_from_rotvec

PER_S = 10.0
_HALF = np.array((3.0, 1.4, 2.5))


@cache
def _wallpaper() -> NDArray[np.float32]:
    noise = np.random.default_rng(0).normal(size=(512, 512)).astype(np.float32)
    smooth = sum(gaussian_filter(noise, sigma, mode="wrap") * sigma for sigma in (2, 5, 12))
    return np.asarray(128 + 90 * np.tanh(smooth), np.float32)


@cache
def view_from(x: float) -> NDArray[np.float32]:
    """Return what a level camera sees from a place in an empty room, (128, 256) grey."""
    center, rays = np.array((x, 0.0, 0.0)), ray_grid(REDUCED_HW).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        to_walls = (np.sign(rays) * _HALF - center) / rays
    wall = to_walls.argmin(axis=1)
    points = center + to_walls.min(axis=1)[:, None] * rays
    # Each wall shows another part of the wallpaper.
    across, down = points[np.arange(len(wall)), (wall + 1) % 3], points[np.arange(len(wall)), (wall + 2) % 3]
    shift = 170 * wall + 80 * (np.take_along_axis(rays, wall[:, None], axis=1)[:, 0] > 0)
    columns, rows = ((60 * axis + shift) % 512 for axis in (across, down))
    seen = cv2.remap(
        _wallpaper(),
        columns.reshape(REDUCED_HW).astype(np.float32),
        rows.reshape(REDUCED_HW).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    return np.asarray(seen, np.float32)


def grey_from(x: float, turn_deg: ArrayLike = (0, 0, 0), *, noise: float = 1.0, seed: int = 0) -> GreyImage:
    """Return the grey image that a camera sees from a place, turned by a rotation vector in degrees."""
    seen = view_from(round(x, 4))
    if np.any(turn_deg):
        seen = rotate_panorama(seen, rotation_from_rotvec(np.radians(turn_deg)))
    grey = seen + np.random.default_rng(seed).normal(0, noise, seen.shape)
    result: GreyImage = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return result


def frames_along(
    places: ArrayLike, turns_deg: ArrayLike | None = None, sharpness: ArrayLike | None = None
) -> Iterator[SmallFrame]:
    """Yield frames at places (N,) on a line, with rotation vectors (N, 3) and sharpness (N,)."""
    along = np.asarray(places, np.float64)
    turns = np.zeros((len(along), 3)) if turns_deg is None else np.asarray(turns_deg, np.float64)
    sharp = np.ones(len(along)) if sharpness is None else np.asarray(sharpness, np.float64)
    for idx, (x, turn) in enumerate(zip(along.tolist(), turns, strict=True)):
        yield SmallFrame(idx / PER_S, grey_from(x, turn, seed=idx), float(sharp[idx]))
