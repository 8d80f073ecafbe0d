"""Resample panoramas, across their seam and poles: to pinhole views, from cubes, and turned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import PinholeView, pad_panorama, ray_from_pixel, ray_grid
from pano_mvs.geometry.positions import positions_in_padded, view_in_padded
from pano_mvs.scene.poses import Poses
from pano_mvs.scene.upright import world_up

_PAD_PX = 4
_BAND_ROWS = 256


def sample_view(
    panorama: NDArray[np.uint8], view: PinholeView, *, interpolation: int = cv2.INTER_CUBIC, samples: int = 1
) -> NDArray[np.uint8]:
    """Return a view's image, (h, w) or (h, w, C) uint8, from a panorama (H, W) or (H, W, C), across seam and poles.

    `panorama`: the full sphere, even W. `view`: the pinhole view. `interpolation`: OpenCV's constant for nearest,
    linear or cubic interpolation. `samples`: number of evenly spread samples in each pixel along each side, which are
    averaged.
    """
    pad_px = min(_PAD_PX, *panorama.shape[:2])
    padded = pad_panorama(panorama, pad_px)
    result = np.empty((*view.size_hw, *panorama.shape[2:]), np.uint8)
    size_hw, places = (panorama.shape[0], panorama.shape[1]), [(step + 0.5) / samples for step in range(samples)]
    for rows in _bands(view.size_hw[0]):
        total = np.zeros(result[rows].shape, np.float32)
        for offset_xy in ((x, y) for y in places for x in places):
            at = view_in_padded(view, size_hw, pad_px, rows=rows, offset_xy=offset_xy)
            total += cv2.remap(padded, at, None, interpolation)
        result[rows] = np.rint(total / samples**2)
    return result


def nearest_pixels(
    view: PinholeView, size_hw: tuple[int, int], *, offset_xy: tuple[float, float] = (0.5, 0.5)
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return row and column, (h, w) each, of the panorama's pixel that contains a position in each of a view's pixels.

    `view`: the pinhole view. `size_hw`: (height, width) of the panorama. `offset_xy`: the position within a pixel;
    (0.5, 0.5) is its centre.
    """
    row, column = np.empty(view.size_hw, np.intp), np.empty(view.size_hw, np.intp)
    for rows in _bands(view.size_hw[0]):
        row[rows], column[rows] = pixels_containing(view.rays(rows, offset_xy=offset_xy), size_hw)
    return row, column


def _bands(height: int) -> Iterator[slice]:
    """Yield bands of rows, so that the rays of a large view are never all in memory."""
    for first in range(0, height, _BAND_ROWS):
        yield slice(first, min(first + _BAND_ROWS, height))


# For each face, its axes to the right, down and forward in the camera frame. As in tours and sky boxes, the lower
# edge of the upper face, and the upper edge of the lower one, lie at the face in front.
CUBE: Mapping[str, tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]] = {
    "f": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "r": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "b": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "l": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "u": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "d": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def panorama_from_cube(faces: Mapping[str, NDArray[np.uint8]], width: int) -> NDArray[np.uint8]:
    """Return a panorama (width / 2, width, 3) from the faces f, r, b, l, u and d of a cube, (S, S, 3) each.

    Raises:
        InputError: if the faces are not squares of one size.
    """
    side = faces["f"].shape[0]
    if any(face.shape != (side, side, 3) for face in faces.values()):
        sizes = ", ".join(f"{name} {face.shape[1]}×{face.shape[0]}" for name, face in faces.items())
        raise InputError(f"the faces of the cube are not squares of one size ({sizes} px). Export the tour again")
    rays = ray_grid((width // 2, width)).astype(np.float32)
    picture = np.zeros((width // 2, width, 3), np.uint8)
    of_face = np.stack([rays @ np.array(axes[2], np.float32) for axes in CUBE.values()]).argmax(axis=0)
    for number, (name, (right, down, forward)) in enumerate(CUBE.items()):
        inside = of_face == number
        ahead = rays[inside] @ np.array(forward, np.float32)
        x, y = ((rays[inside] @ np.array(axis, np.float32) / ahead + 1) * (side / 2) - 0.5 for axis in (right, down))
        # OpenCV takes fewer than 2^15 rows. The outermost half pixel of a face repeats its border.
        parts = [np.array_split(part[:, None], len(x) // 30_000 + 1) for part in (x, y)]
        sampled = [
            cv2.remap(faces[name], at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for at_x, at_y in zip(*parts, strict=True)
        ]
        picture[inside] = np.concatenate(sampled)[:, 0]
    return picture


Facing = Literal["north", "path", "own"]
_CUBIC_PAD_PX = 2  # bicubic interpolation takes two pixels on either side


def level_from_world(poses: Poses, facing: Facing) -> FloatArray:
    """Return the rotations (N, 3, 3) from the world to level axes of each camera: x right, y down, z ahead.

    `poses`: poses of one group. `facing`: what lies ahead. north: the world's z, which is north if a compass or GPS
    turned the world; path: the way to the next camera, for the last one from the camera before; own: what the camera
    looks at.
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

    `panorama`: (H, W) or (H, W, C), of a type that OpenCV resamples. `new_from_old`: (3, 3) rotation; a ray r of the
    old frame appears as new_from_old @ r in the new one. `interpolation`: of OpenCV.

    Returns:
        An array of the same shape and type.
    """
    height, width = panorama.shape[:2]
    padded = pad_panorama(panorama, _CUBIC_PAD_PX)
    turned = np.empty_like(panorama)
    x = np.arange(width) + 0.5
    for first in range(0, height, _BAND_ROWS):
        y = np.arange(first, min(first + _BAND_ROWS, height)) + 0.5
        rays = ray_from_pixel(np.stack(np.meshgrid(x, y), axis=-1), (height, width)) @ new_from_old
        at = positions_in_padded(rays, (height, width), _CUBIC_PAD_PX)
        turned[first : first + len(y)] = cv2.remap(padded, at, None, interpolation)
    return turned
