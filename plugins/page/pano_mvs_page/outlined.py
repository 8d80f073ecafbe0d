"""What the page shows of a panorama that has no ranges: the room around it, as outlined by its picture alone."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_from_pixel, ray_grid, sample_panorama, spiral_rays
from pano_mvs.scene import PointCloud, RoomOutline
from pano_mvs_page.mesh_file import SharedMesh

ROOM_UNCERTAINTY = 0.05
"""Relative standard deviation of ranges on walls that pictures outline; see `RoomOutline.probabilities`."""
_LEAST_PROBABILITY = 0.5
_POINTS = 60_000
_ROWS = 96  # of the mesh
_TEXTURE_HW = (512, 1024)
_BESIDE = 4  # azimuths that tell which direction a wall has
_LEAST_COSINE, _MOST_CLOSED = 0.1, 135
# Neighbours are on one surface if their ranges differ by less than this factor.
_SAME_SURFACE = 1.25


def closed_walls(room: RoomOutline) -> FloatArray:
    """Return the distance of the wall at each azimuth, (360,), NaN where none is near.

    Walls that are probably wrong are left out. There, and where none is known, those on both sides go on to where they
    meet, up to a right angle and a half away: an opening is closed by the wall that it is in.
    """
    known = np.where(room.probabilities >= _LEAST_PROBABILITY, room.distances, np.nan).astype(np.float64)
    count = len(known)
    azimuths = np.arange(count) * 2 * np.pi / count
    gap = np.isnan(known)
    if room.wall_rad is None or gap.all() or not gap.any():
        return known
    closed = known.copy()
    for step in (1, -1):
        # From each gap, go back to the nearest known azimuth.
        back = np.zeros(count, np.int64)
        for _ in range(count):
            back = np.where(np.isnan(known[(np.arange(count) - step * back) % count]), back + 1, back)
        edge = (np.arange(count) - step * back) % count
        beside = (edge[:, None] - step * np.arange(_BESIDE)) % count
        directions = room.wall_rad + np.arange(4) * np.pi / 2
        cosines = np.cos(azimuths[beside][..., None] - directions)
        depths = known[beside][..., None] * cosines  # of the planes of four directions
        spread = np.where((cosines > _LEAST_COSINE).all(axis=1), np.ptp(depths, axis=1), np.inf)
        spread = np.where(np.isnan(spread), np.inf, spread)
        best = spread.argmin(axis=1)
        rows = np.arange(count)
        cosine = np.cos(azimuths - directions[best])
        reaches = np.isfinite(spread[rows, best]) & (cosine > _LEAST_COSINE) & (back <= _MOST_CLOSED)
        extended = np.where(reaches, depths[rows, 0, best] / np.where(reaches, cosine, 1.0), np.inf)
        closed = np.where(gap, np.fmin(closed, extended), closed)
    return np.where(np.isfinite(closed), closed, np.nan)


def room_ranges(room: RoomOutline, rays_in_cam: FloatArray, *, camera_height: float) -> FloatArray:
    """Return the range to floor, ceiling or wall along unit rays (..., 3); NaN towards walls that are not known.

    `camera_height`: above the floor, in the unit of the ranges.
    """
    rays = rays_in_cam @ room.cam_from_level
    level = np.hypot(rays[..., 0], rays[..., 2])
    walls = closed_walls(room)
    count = len(walls)
    place = np.arctan2(rays[..., 0], rays[..., 2]) % (2 * np.pi) * count / (2 * np.pi)
    first = np.floor(place).astype(np.int64) % count
    part, here, there = place % 1.0, walls[first], walls[(first + 1) % count]
    with np.errstate(invalid="ignore", divide="ignore"):
        joined = np.maximum(here, there) < _SAME_SURFACE * np.minimum(here, there)
        # Along a straight wall, the reciprocal of its distance is nearly linear.
        between = 1 / ((1 - part) / here + part / there)
        wall = np.where(joined, between, np.where(part < 0.5, here, there)) / level
        height = np.where(rays[..., 1] > 0, 1.0, room.ceiling or np.nan) / np.abs(rays[..., 1])
    return np.asarray(np.minimum(wall, height) * camera_height)


def room_cloud(
    room: RoomOutline, picture: NDArray[np.uint8], cam_from_house: Rigid3, *, camera_height: float
) -> PointCloud:
    """Return points on floor, ceiling and walls, with the colours of the panorama (H, W, 3)."""
    rays = spiral_rays(_POINTS)
    ranges = room_ranges(room, rays, camera_height=camera_height)
    known = np.isfinite(ranges)
    rays, ranges = rays[known], ranges[known]
    size = picture.shape[0], picture.shape[1]
    colors = sample_panorama(picture, pixel_from_ray(rays, size)).round().astype(np.uint8)
    house_from_cam = cam_from_house.inverse()
    return PointCloud(
        points_in_world=house_from_cam.apply(rays * ranges[:, None]).astype(np.float32),
        normals_in_world=(-rays @ house_from_cam.rotation.T).astype(np.float32),
        colors_rgb=colors,
        view_counts=np.ones(len(rays), np.uint8),
        uncertainty=(ROOM_UNCERTAINTY * ranges).astype(np.float32),
    )


def room_mesh(
    room: RoomOutline,
    picture: NDArray[np.uint8],
    cam_from_house: Rigid3,
    *,
    camera_height: float,
    textured: bool,
) -> SharedMesh:
    """Return floor, ceiling and walls as a mesh, with the panorama (H, W, 3) as its texture or as colours."""
    rows, columns = _ROWS, 2 * _ROWS
    size = float(columns), float(rows)
    across, down = np.meshgrid(np.arange(columns + 1.0), np.linspace(0.02, rows - 0.02, rows + 1))
    pixels = np.stack([across, down], axis=-1)
    rays = ray_from_pixel(pixels, (rows, columns))
    ranges = room_ranges(room, rays, camera_height=camera_height)
    vertices = cam_from_house.inverse().apply((rays * ranges[..., None]).reshape(-1, 3))
    corner = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    upper_left, upper_right = corner[:-1, :-1], corner[:-1, 1:]
    lower_left, lower_right = corner[1:, :-1], corner[1:, 1:]
    faces = np.concatenate(
        [
            np.stack([upper_left, lower_left, lower_right], axis=-1).reshape(-1, 3),
            np.stack([upper_left, lower_right, upper_right], axis=-1).reshape(-1, 3),
        ]
    )
    of_face = ranges.reshape(-1)[faces]
    with np.errstate(invalid="ignore"):
        faces = faces[of_face.max(axis=1) < _SAME_SURFACE * of_face.min(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    kept = vertices[used].astype(np.float32), faces.reshape(-1, 3).astype(np.int32)
    if textured:
        uv = pixels.reshape(-1, 2)[used] / size
        texture = cv2.resize(picture, _TEXTURE_HW[::-1], interpolation=cv2.INTER_AREA)
        return SharedMesh(
            *kept,
            uv=np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1).astype(np.float32),
            texture=np.asarray(texture, np.uint8),
        )
    shown = sample_panorama(picture, pixel_from_ray(rays.reshape(-1, 3)[used], (picture.shape[0], picture.shape[1])))
    return SharedMesh(*kept, colors_rgb=shown.round().astype(np.uint8))


def room_map(room: RoomOutline, size_hw: tuple[int, int], *, camera_height: float) -> NDArray[np.float32]:
    """Return the ranges of a room at all pixels of a panorama, (H, W) float32."""
    return room_ranges(room, ray_grid(size_hw), camera_height=camera_height).astype(np.float32)
