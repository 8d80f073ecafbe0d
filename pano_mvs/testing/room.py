"""A synthetic room, its textures and paint, whose range is known in closed form, as ground truth for tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, ray_from_pixel, rotation_from_quat_wxyz, rotation_from_rotvec
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Surface, Vector, sum_of_three

_RAYS_AT_ONCE = 1 << 14  # their arrays fit into the cache of a core


@dataclass(frozen=True)
class Room:
    """Surfaces with a texture, and one lamp."""

    surfaces: tuple[Surface, ...]
    # texture of all surfaces: "strong" (features everywhere), "weak" (nearly plain walls), "isotropic", "outdoor"
    # (coarse and fine, the fine part fading with distance) or "none" (paint)
    texture: Texture = "strong"
    seed: int = 0
    lamp: Vector = (0.4, -1.2, 0.3)  # position of the light; the shading is diffuse, without shadows
    textures: tuple[Texture | Pattern, ...] = ()  # texture of each surface, if they differ; empty: all have `texture`
    # colours at the zenith and at the horizon where a ray meets no surface, with clouds that are infinitely far away;
    # None: black
    sky: tuple[Vector, Vector] | None = None
    clouds: float = 0.35  # strength of the clouds; 0 is a clear sky


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
    distances = None
    for offset_px in product(steps.tolist(), steps.tolist()):
        found, shades = _traced(room, cam_from_world, size_hw, offset_px=offset_px)
        colors += shades
        distances = found if offset_px == (0.5, 0.5) else distances
    if distances is None:
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
        towards = getattr(surface, "towards", None)  # most surfaces say which rays come near them
        rows = None if towards is None else towards(origin, rays)
        distance, normal = surface.hit(origin, rays if rows is None else rays[rows])
        nearer = np.flatnonzero(distance < (best if rows is None else best[rows]))
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
        on = np.flatnonzero(surface_idx == idx)
        if not len(on):
            continue
        points = origin + distances[on, None] * rays[on]
        texture = room.textures[idx] if room.textures else room.texture
        footprint = pixel_rad * distances[on]
        if isinstance(texture, str):
            seed = 1000 * room.seed + 2 * idx
            albedo = albedo_at(points, surface.colors_rgb, texture, seed=seed, footprint=footprint)
        else:
            # A pixel on a slanted surface is longer than wide; a value in between neither flickers nor blurs much.
            slant = np.abs(sum_of_three(rays[on] * normals[on]))
            albedo = texture.albedo(points, normals[on], footprint=footprint / np.sqrt(np.maximum(slant, 0.02)))
        to_lamp = np.array(room.lamp) - points
        facing = np.abs(sum_of_three(to_lamp * normals[on])) / np.maximum(np.sqrt(sum_of_three(to_lamp**2)), 1e-9)
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


Texture = Literal["strong", "weak", "faint", "isotropic", "outdoor", "none"]

Colors = tuple[Vector, Vector]


class Pattern(Protocol):
    """A texture with its own colours."""

    def albedo(self, points: FloatArray, normals: FloatArray, *, footprint: FloatArray) -> FloatArray:
        """Return the unlit colours (N, 3) of points (N, 3) with normals (N, 3), for pixels of width `footprint`."""


# Cell sizes in scene units, with the amplitude of the noise on each.
_LIGHTNESS: dict[Texture, tuple[tuple[float, float], ...]] = {
    "strong": ((0.018, 0.4), (0.055, 0.5), (0.19, 0.5)),
    "weak": ((0.047, 0.03), (0.16, 0.05)),
    "faint": ((0.047, 0.01), (0.16, 0.018)),
    "isotropic": ((0.015, 0.7), (0.047, 0.7)),
    "outdoor": ((0.012, 0.25), (0.04, 0.25), (0.13, 0.3), (0.5, 0.3)),
    "none": (),
}
_HUE: dict[Texture, tuple[tuple[float, float], ...]] = {
    "strong": ((0.06, 1.0),),
    "weak": ((0.2, 0.15),),
    "faint": ((0.2, 0.05),),
    "isotropic": ((0.06, 0.6),),
    "outdoor": ((0.25, 0.8),),
    "none": (),
}


def albedo_at(
    points: FloatArray, colors_rgb: Colors, texture: Texture, *, seed: int, footprint: FloatArray
) -> FloatArray:
    """Return the unlit colours (N, 3) of points (N, 3) of a surface.

    Args:
        points: in world coordinates; a point has the same colour from every viewpoint.
        colors_rgb: the two colours between which the hue varies.
        footprint: (N,) width of a pixel at each point. The texture "outdoor" fades where a pixel averages over its
            waves, since a far wall would otherwise flicker between views; the others do not depend on it.
    """
    share = 0.5 + 0.5 * np.tanh(_octaves(points, _HUE[texture], texture, seed=seed, footprint=footprint))
    lightness = _octaves(points, _LIGHTNESS[texture], texture, seed=seed + 1, footprint=footprint)
    first, second = np.array(colors_rgb)
    albedo: FloatArray = share[:, None] * first + (1 - share[:, None]) * second
    return albedo * (1 + 0.65 * np.tanh(lightness)[:, None])


def _octaves(
    points: FloatArray, cells: tuple[tuple[float, float], ...], texture: Texture, *, seed: int, footprint: FloatArray
) -> FloatArray:
    """Return the sum of the noise (N,) of all cell sizes, fading for the texture "outdoor"."""
    if texture != "outdoor":
        return noise(points, cells=cells, seed=seed)
    total = np.zeros(len(points))
    for octave, (size, strength) in enumerate(cells):
        # Mean wavelength of the noise in cells.
        left = np.exp(-((2 * footprint / (7.0 * size)) ** 2))
        total += left * noise(points, cells=((size, strength),), seed=seed + 7919 * octave)
    return total


def sky_color(rays_in_world: FloatArray, sky: tuple[Vector, Vector], *, seed: int, clouds: float = 0.35) -> FloatArray:
    """Return the colours (N, 3) of the sky along unit rays (N, 3); clouds are infinitely far away, and 1 is thick."""
    zenith, horizon = np.array(sky)
    height = np.clip(-rays_in_world[:, 1], 0, 1)[:, None] ** 0.5
    clear: FloatArray = height * zenith + (1 - height) * horizon
    if not clouds:
        return clear
    cloud = 0.5 + 0.5 * np.tanh(noise(rays_in_world, cells=((0.06, 0.8),), seed=seed + 0x5C))[:, None]
    mixed: FloatArray = clear + clouds * cloud * (1 - clear)
    return mixed


_CELLS = 64


def noise(points: FloatArray, *, cells: Sequence[tuple[float, float]], seed: int) -> FloatArray:
    """Return smooth noise, about normally distributed, at points.

    Args:
        points: (N, 3).
        cells: pairs of cell size in scene units and standard deviation of the noise on that lattice; its wavelengths
            are 4 to 12 cells.
        seed: each seed gives an independent texture.

    Returns:
        (N,) values with mean near 0.
    """
    rng = np.random.default_rng(seed)
    total = np.zeros(len(points))
    for size, strength in cells:
        turn = rotation_from_quat_wxyz(rng.normal(size=4))  # so that no lattice is parallel to a wall
        offset = rng.uniform(0, _CELLS, 3)
        total += strength * _interpolated(points @ (turn / size) + offset)
    return total


def _interpolated(positions: FloatArray) -> FloatArray:
    """Return the periodic volume at positions (N, 3) in cells, by trilinear interpolation."""
    volume = _volume().ravel()
    low = np.floor(positions.T)
    weights, index = positions.T - low, low.astype(np.int64)
    steps = (_CELLS * _CELLS, _CELLS, 1)
    sides = [
        ((1 - weight, (cell & (_CELLS - 1)) * step), (weight, ((cell + 1) & (_CELLS - 1)) * step))
        for weight, cell, step in zip(weights, index, steps, strict=True)
    ]
    result = np.zeros(len(positions))
    for (x_share, x_idx), (y_share, y_idx) in product(sides[0], sides[1]):
        share, idx = x_share * y_share, x_idx + y_idx
        for z_share, z_idx in sides[2]:
            result += share * z_share * volume[idx + z_idx]
    return result


@lru_cache(maxsize=1)
def _volume() -> FloatArray:
    """Return periodic, isotropic, band-limited noise of unit variance, (64, 64, 64)."""
    white = np.random.default_rng(0x3D).normal(size=(_CELLS,) * 3)
    frequency = np.fft.fftfreq(_CELLS)
    radius = np.sqrt(np.sum(np.stack(np.meshgrid(frequency, frequency, frequency)) ** 2, axis=0))
    # Wavelengths of the noise in cells: trilinear interpolation needs about four cells to be smooth.
    band = (radius >= 1 / 12) & (radius <= 1 / 4)
    filtered = np.fft.ifftn(np.fft.fftn(white) * band).real
    return np.asarray(filtered / filtered.std())
