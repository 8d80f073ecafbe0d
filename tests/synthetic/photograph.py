"""Photographs of synthetic rooms by cameras with a lens, with known pose, focal length and distortion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.testing.room import Room
from tests.synthetic.colors import colors_along

_ROUNDS = 20
_RAYS_AT_ONCE = 1 << 17


def render_photograph(
    room: Room,
    cam_from_world: Rigid3,
    size_hw: tuple[int, int],
    *,
    focal_px: float,
    radial: float = 0.0,
    supersample: int = 2,
) -> NDArray[np.uint8]:
    """Return a photograph (H, W, 3) uint8 RGB by a SIMPLE_RADIAL camera; see `pano_mvs.scene.photographs.Photographs`.

    Args:
        room: the room to render.
        cam_from_world: any pose; the camera looks along its z axis.
        size_hw: (height, width) of the photograph.
        focal_px: focal length.
        radial: coefficient of the distortion; it must not fold the picture.
        supersample: number of rays per pixel along each side, averaged.
    """
    height, width = size_hw
    colors = np.zeros((height * width, 3))
    steps = (np.arange(supersample) + 0.5) / supersample
    for start in range(0, height * width, _RAYS_AT_ONCE):
        block = slice(start, min(start + _RAYS_AT_ONCE, height * width))
        row, column = np.divmod(np.arange(block.start, block.stop), width)
        for y in steps:
            for x in steps:
                distorted = (np.stack([column + x, row + y], axis=-1) - (width / 2, height / 2)) / focal_px
                rays = np.concatenate([_undistorted(distorted, radial), np.ones((len(distorted), 1))], axis=1)
                rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ cam_from_world.rotation
                colors[block] += colors_along(room, cam_from_world.center, rays, pixel_rad=1 / focal_px)
    return np.asarray(np.rint(colors * (255 / supersample**2)), np.uint8).reshape(height, width, 3)


def _undistorted(distorted: NDArray[np.float64], radial: float) -> NDArray[np.float64]:
    """Return the points (N, 2) of the plane z = 1 that the distortion moves to the given ones."""
    plane = distorted
    for _ in range(_ROUNDS if radial else 0):
        plane = distorted / (1 + radial * (plane**2).sum(axis=1, keepdims=True))
    return plane
