"""Colours along any rays of a synthetic room."""

from __future__ import annotations

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.testing.room import _RAYS_AT_ONCE, Room, _first_hit, _shaded


def colors_along(room: Room, origin_in_world: FloatArray, rays_in_world: FloatArray, *, pixel_rad: float) -> FloatArray:
    """Return the colours (N, 3) in [0, 1] that a camera at a point (3,) sees along unit rays (N, 3).

    Args:
        origin_in_world: centre of the camera.
        rays_in_world: directions.
        pixel_rad: width of a pixel in radians, over which fine texture fades.
    """
    colors = np.zeros_like(rays_in_world)
    for start in range(0, len(rays_in_world), _RAYS_AT_ONCE):
        block = slice(start, start + _RAYS_AT_ONCE)
        rays = rays_in_world[block]
        hits = _first_hit(room, origin_in_world, rays)
        colors[block] = _shaded(room, origin_in_world, rays, hits=hits, pixel_rad=pixel_rad)
    return colors
