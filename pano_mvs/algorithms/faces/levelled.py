"""Turn panoramas so that they are level and face north, along the path, or as they were taken."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pad_panorama, pixel_from_ray, ray_from_pixel
from pano_mvs.scene.poses import Poses
from pano_mvs.scene.upright import world_up

Facing = Literal["north", "path", "own"]
_PAD_PX = 2  # bicubic interpolation takes two pixels on either side
_BAND_ROWS = 256


def level_from_world(poses: Poses, facing: Facing) -> FloatArray:
    """Return the rotations (N, 3, 3) from the world to level axes of each camera: x right, y down, z ahead.

    Args:
        poses: poses of one group.
        facing: what lies ahead. north: the world's z, which is north if a compass or GPS turned the world; path: the
            way to the next camera, for the last one from the camera before; own: what the camera looks at.
    """
    down = -world_up(poses)
    # Where a direction is vertical or has no length, the next one counts.
    candidates = [_toward_next(poses.centers)] if facing == "path" else []
    candidates += [poses.rotations[:, 2], poses.rotations[:, 0]] if facing == "own" else []
    candidates += [np.broadcast_to(axis, poses.centers.shape) for axis in np.eye(3)[[2, 1, 0]]]
    ahead = np.full(poses.centers.shape, np.nan)
    for direction in candidates:
        level = direction - (direction @ down)[:, None] * down
        length = np.linalg.norm(level, axis=1, keepdims=True)
        usable = (length > 1e-6 * np.linalg.norm(direction, axis=1, keepdims=True)) & np.isnan(ahead)
        ahead = np.where(usable, level / np.where(usable, length, 1), ahead)
    downs = np.broadcast_to(down, ahead.shape)
    return np.stack([np.cross(downs, ahead), downs, ahead], axis=1)


def _toward_next(centers: FloatArray) -> FloatArray:
    steps = np.diff(centers, axis=0)
    return np.concatenate([steps, steps[-1:]]) if len(steps) else np.zeros_like(centers)


def turned_panorama(
    panorama: NDArray[np.generic], new_from_old: FloatArray, *, interpolation: int = cv2.INTER_CUBIC
) -> NDArray[np.generic]:
    """Return the panorama as the same camera would see it after a turn about its centre.

    Args:
        panorama: (H, W) or (H, W, C), of a type that OpenCV resamples.
        new_from_old: (3, 3) rotation; a ray r of the old frame appears as new_from_old @ r in the new one.
        interpolation: of OpenCV.

    Returns:
        An array of the same shape and type.
    """
    height, width = panorama.shape[:2]
    padded = pad_panorama(panorama, _PAD_PX)
    turned = np.empty_like(panorama)
    x = np.arange(width) + 0.5
    for first in range(0, height, _BAND_ROWS):
        y = np.arange(first, min(first + _BAND_ROWS, height)) + 0.5
        rays = ray_from_pixel(np.stack(np.meshgrid(x, y), axis=-1), (height, width)) @ new_from_old
        at = (pixel_from_ray(rays, (height, width)) + (_PAD_PX - 0.5)).astype(np.float32)
        turned[first : first + len(y)] = cv2.remap(padded, at[..., 0], at[..., 1], interpolation)
    return turned
