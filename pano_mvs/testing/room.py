"""A synthetic room whose range is known in closed form, as ground truth for tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, ray_from_pixel, rotation_from_rotvec
from pano_mvs.testing.paint import Pattern, Texture, albedo_at, sky_color
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Surface, Vector

_RAYS_AT_ONCE = 1 << 14  # their arrays fit into the cache of a core


@dataclass(frozen=True)
class Room:
    """Surfaces with a texture, and one lamp.

    Attributes:
        texture: texture of all surfaces: "strong" (features everywhere), "weak" (nearly plain walls), "isotropic",
            "outdoor" (coarse and fine, the fine part fading with distance) or "none" (paint).
        lamp: position of the light; the shading is diffuse, without shadows.
        textures: texture of each surface, if they differ; empty: all have `texture`.
        sky: colours at the zenith and at the horizon where a ray meets no surface, with clouds that are infinitely far
            away; None: black.
        clouds: strength of the clouds; 0 is a clear sky.
    """

    surfaces: tuple[Surface, ...]
    texture: Texture = "strong"
    seed: int = 0
    lamp: Vector = (0.4, -1.2, 0.3)
    textures: tuple[Texture | Pattern, ...] = ()
    sky: tuple[Vector, Vector] | None = None
    clouds: float = 0.35


def default_room(seed: int = 0, texture: Texture = "strong") -> Room:
    """Return a furnished room of 6 × 2.8 × 5 units, without furniture within 0.8 of its origin (y is down).

    With the texture "isotropic" it is an empty sphere of radius 2 around the origin, which looks alike in all
    directions.
    """
    if texture == "isotropic":
        return Room((Ball((0.0, 0.0, 0.0), 2.0, ((0.75, 0.7, 0.6), (0.35, 0.45, 0.6))),), texture, seed, (0, 0, 0))
    return Room(_furniture(), texture, seed)


def capture_poses(count: int, *, seed: int = 0, spread: float = 0.6, tilt_deg: float = 10.0) -> list[Rigid3]:
    """Return cameras in the free centre of the default room, with arbitrary heading and small tilt.

    Args:
        spread: half the side of the cube that contains the centres; heights vary by half of it.
        tilt_deg: standard deviation of the tilt about a horizontal axis.

    Returns:
        cam_from_world of each; the first is the identity.
    """
    rng = np.random.default_rng(seed)
    poses = [Rigid3.identity()]
    while len(poses) < count:
        center = rng.uniform(-spread, spread, 3) * (1, 0.5, 1)
        if min(float(np.linalg.norm(center - pose.center)) for pose in poses) < spread / count:
            continue
        tilt = rng.normal(size=3) * np.radians(tilt_deg) * (1, 0, 1)
        heading = (0.0, rng.uniform(-np.pi, np.pi), 0.0)
        poses.append(Rigid3.from_center(rotation_from_rotvec(tilt) @ rotation_from_rotvec(heading), center))
    return poses[:count]


def render(
    room: Room, cam_from_world: Rigid3, size_hw: tuple[int, int], *, supersample: int = 2
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Render a panorama of the room and its ranges.

    Args:
        cam_from_world: any pose.
        supersample: number of rays per pixel along each side, averaged for the colour.

    Returns:
        Two arrays: (H, W, 3) uint8 RGB, and (H, W) float32 range along the ray through each pixel's exact centre, NaN
        where the ray meets no surface.
    """
    height, width = size_hw
    steps = (np.arange(supersample) + 0.5) / supersample
    colors = np.zeros((height * width, 3))
    for offset_y in steps:
        for offset_x in steps:
            colors += _traced(room, cam_from_world, size_hw, offset_px=(float(offset_x), float(offset_y)))[1]
    distances, _ = _traced(room, cam_from_world, size_hw, offset_px=(0.5, 0.5), shaded=False)
    image = np.rint(colors * (255 / supersample**2)).astype(np.uint8).reshape(height, width, 3)
    ranges = np.where(np.isfinite(distances), distances, np.nan).astype(np.float32)
    return image, ranges.reshape(height, width)


def range_along(room: Room, origin_in_world: FloatArray, rays_in_world: FloatArray) -> FloatArray:
    """Return the exact distance from a point (3,) to the first surface along unit rays (N, 3); (N,), else inf."""
    return _first_hit(room, origin_in_world, rays_in_world)[0]


def _traced(
    room: Room, cam_from_world: Rigid3, size_hw: tuple[int, int], *, offset_px: tuple[float, float], shaded: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Return distance (H W,) and colour (H W, 3) along the rays through one position within each pixel."""
    height, width = size_hw
    origin = cam_from_world.center
    distances, colors = np.zeros(height * width), np.zeros((height * width, 3))
    for start in range(0, height * width, _RAYS_AT_ONCE):
        block = slice(start, min(start + _RAYS_AT_ONCE, height * width))
        row, column = np.divmod(np.arange(block.start, block.stop), width)
        pixels = np.stack([column + offset_px[0], row + offset_px[1]], axis=-1)
        rays = ray_from_pixel(pixels, size_hw) @ cam_from_world.rotation
        distances[block], surface_idx, normals = _first_hit(room, origin, rays)
        if shaded:
            colors[block] = _shaded(
                room, origin, rays, hits=(distances[block], surface_idx, normals), pixel_rad=np.pi / height
            )
    return distances, colors


def _first_hit(room: Room, origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, NDArray[np.int64], FloatArray]:
    """Return distance, index of the surface (−1: none) and normal where each ray first meets a surface."""
    best, which, normals = np.full(len(rays), np.inf), np.full(len(rays), -1), np.zeros_like(rays)
    for idx, surface in enumerate(room.surfaces):
        towards = getattr(surface, "towards", None)  # large scenes have surfaces that say which rays come near them
        rows = None if towards is None else towards(origin, rays)
        distance, normal = surface.hit(origin, rays if rows is None else rays[rows])
        nearer = distance < (best if rows is None else best[rows])
        on = nearer if rows is None else rows[nearer]
        best[on], which[on], normals[on] = distance[nearer], idx, normal[nearer]
    return best, which, normals


def _shaded(
    room: Room,
    origin: FloatArray,
    rays: FloatArray,
    *,
    hits: tuple[FloatArray, NDArray[np.int64], FloatArray],
    pixel_rad: float,
) -> FloatArray:
    """Return the colours (N, 3) in [0, 1] of what rays meet; those of the sky, or black, without a surface."""
    distances, surface_idx, normals = hits
    colors = np.zeros_like(rays)
    for idx, surface in enumerate(room.surfaces):
        on = surface_idx == idx
        if not on.any():
            continue
        points = origin + distances[on, None] * rays[on]
        texture = room.textures[idx] if room.textures else room.texture
        footprint = pixel_rad * distances[on]
        if isinstance(texture, str):
            seed = 1000 * room.seed + 2 * idx
            albedo = albedo_at(points, surface.colors_rgb, texture, seed=seed, footprint=footprint)
        else:
            # A pixel on a slanted surface is longer than wide; a value in between neither flickers nor blurs much.
            slant = np.abs(np.sum(rays[on] * normals[on], axis=1))
            albedo = texture.albedo(points, normals[on], footprint=footprint / np.sqrt(np.maximum(slant, 0.02)))
        to_lamp = np.array(room.lamp) - points
        facing = np.abs(np.sum(to_lamp * normals[on], axis=1)) / np.maximum(np.linalg.norm(to_lamp, axis=1), 1e-9)
        colors[on] = albedo * (0.55 + 0.45 * facing[:, None])
    if room.sky is not None:
        nothing = surface_idx < 0
        colors[nothing] = sky_color(rays[nothing], room.sky, seed=room.seed, clouds=room.clouds)
    return np.clip(colors, 0, 1)


def _furniture() -> tuple[Surface, ...]:
    """Return the walls, a cupboard, a table, a bench, a leaning board, a screen, and three balls."""
    oak, wall = ((0.62, 0.44, 0.27), (0.42, 0.28, 0.17)), ((0.72, 0.72, 0.66), (0.55, 0.58, 0.60))
    blue, red = ((0.25, 0.38, 0.62), (0.45, 0.60, 0.75)), ((0.70, 0.26, 0.22), (0.80, 0.52, 0.40))
    green = ((0.30, 0.52, 0.32), (0.62, 0.70, 0.36))
    return (
        Cuboid((-3.0, -1.5, -2.5), (3.0, 1.3, 2.5), wall),
        Cuboid((-2.9, -0.7, 1.7), (-1.6, 1.3, 2.45), oak),
        Cuboid((0.6, 0.45, 1.2), (2.2, 0.52, 2.1), oak),
        Cuboid((0.7, 0.52, 1.3), (0.8, 1.3, 1.4), oak),
        Cuboid((2.0, 0.52, 1.9), (2.1, 1.3, 2.0), oak),
        Cuboid((-2.2, 0.85, -2.3), (-0.4, 1.3, -1.7), green),
        Quad((1.6, -0.9, -2.3), (1.2, 0.0, 0.5), (-0.1, 2.2, 0.5), blue),
        Quad((-2.7, -0.5, -0.9), (0.1, 0.0, 1.4), (0.0, 0.9, 0.0), red),
        Ball((1.3, 0.20, 1.6), 0.25, red),
        Ball((-1.5, 0.95, 0.6), 0.35, blue),
        Ball((0.9, -0.7, -1.4), 0.3, green),
    )
