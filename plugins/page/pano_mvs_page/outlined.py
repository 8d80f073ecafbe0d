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
CLOSED_UNCERTAINTY = 0.4
"""The same where walls beside them close a gap: 68 % of 3,600 azimuths of eight rendered houses are within it, and of
2,300 of ZInD's sample tour."""
_LEAST_PROBABILITY = 0.5
_POINTS = 60_000
_ROWS = 96  # of the mesh of a room; fewer if there are many
_TEXTURE_HW = (512, 1024)
_ALL_TRIANGLES, _ALL_TEXELS = 400_000, 8_000_000  # of the rooms together
_WHOLE = 4  # azimuths of a wall that is no sliver, and that show its direction
_LEAST_COSINE = 0.1
_FARTHER = 1.5  # walls that close a gap are at most as much farther than those beside it
# Neighbours are on one surface if their ranges differ by less than this factor.
_SAME_SURFACE = 1.25


def closed_walls(room: RoomOutline) -> FloatArray:
    """Return the distance of the wall at each azimuth, (360,), NaN where none is near.

    Walls that are probably wrong are left out, as are slivers. There, the walls on both sides go on to where they meet:
    an opening is closed by the wall that it is in.
    """
    known = np.where(room.probabilities >= _LEAST_PROBABILITY, room.distances, np.nan).astype(np.float64)
    count = len(known)
    rows = np.arange(count)
    finite = np.isfinite(known).astype(np.uint8)[None]
    # Whether each azimuth is in a run of known ones that is long enough.
    twice = cv2.morphologyEx(np.tile(finite, 3), cv2.MORPH_OPEN, np.ones((1, _WHOLE + 1), np.uint8))
    inside = np.asarray(twice[0, count : 2 * count] > 0)
    known[~inside] = np.nan
    if room.wall_rad is None or inside.all() or not inside.any():
        return known
    directions = room.wall_rad + np.arange(4) * np.pi / 2
    azimuths = rows * 2 * np.pi / count
    cosines = np.cos(azimuths[:, None] - directions)
    reached, farthest = np.full(count, np.inf), np.zeros(count)
    for step in (1, -1):
        places = np.arange(2 * count) * step  # twice around
        last = np.maximum.accumulate(np.where(inside[places % count], np.arange(2 * count), -1))[count:]
        edge = np.empty(count, np.int64)
        edge[places[count:] % count] = (last * step) % count
        beside = (edge[:, None] - step * np.arange(_WHOLE)) % count
        depths = known[beside][..., None] * cosines[beside]  # of planes of the four directions
        spread = np.where((cosines[beside] > _LEAST_COSINE).all(axis=1), np.ptp(depths, axis=1), np.inf)
        best = spread.argmin(axis=1)
        goes_on = cosines[rows, best] > _LEAST_COSINE
        extended = depths[rows, 0, best] / np.where(goes_on, cosines[rows, best], 1.0)
        reached = np.minimum(reached, np.where(goes_on, extended, np.inf))
        farthest = np.maximum(farthest, known[edge])
    closes = ~inside & (reached < _FARTHER * farthest)
    return np.where(closes, reached, known)


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
    """Return points on floor and walls, with the colours of the panorama (H, W, 3).

    The ceiling is left out, which would hide the room from above.
    """
    rays = spiral_rays(_POINTS)
    ranges = room_ranges(room, rays, camera_height=camera_height)
    height = -(rays @ room.cam_from_level)[:, 1] * ranges
    known = np.isfinite(ranges) & (height < 0.99 * camera_height * (room.ceiling or np.inf))
    rays, ranges = rays[known], ranges[known]
    size = picture.shape[0], picture.shape[1]
    colors = sample_panorama(picture, pixel_from_ray(rays, size)).round().astype(np.uint8)
    house_from_cam = cam_from_house.inverse()
    return PointCloud(
        points_in_world=house_from_cam.apply(rays * ranges[:, None]).astype(np.float32),
        normals_in_world=(-rays @ house_from_cam.rotation.T).astype(np.float32),
        colors_rgb=colors,
        view_counts=np.ones(len(rays), np.uint8),
        uncertainty=(_deviations(room, rays @ room.cam_from_level) * ranges).astype(np.float32),
    )


def room_mesh(
    room: RoomOutline,
    picture: NDArray[np.uint8],
    cam_from_house: Rigid3,
    *,
    camera_height: float,
    textured: bool,
    count: int = 1,
) -> SharedMesh:
    """Return floor, ceiling and walls as a mesh, with the panorama (H, W, 3) as its texture or as colours.

    `count`: number of rooms of the page, of which many are coarser.
    """
    rows = min(_ROWS, max(24, int(np.sqrt(_ALL_TRIANGLES / count / 4))))
    columns = 2 * rows
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
        height = min(_TEXTURE_HW[0], max(64, int(np.sqrt(_ALL_TEXELS / count / 2)) // 2 * 2))
        texture = cv2.resize(picture, (2 * height, height), interpolation=cv2.INTER_AREA)
        return SharedMesh(
            *kept,
            uv=np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1).astype(np.float32),
            texture=np.asarray(texture, np.uint8),
        )
    shown = sample_panorama(picture, pixel_from_ray(rays.reshape(-1, 3)[used], (picture.shape[0], picture.shape[1])))
    return SharedMesh(*kept, colors_rgb=shown.round().astype(np.uint8))


def room_map(
    room: RoomOutline, size_hw: tuple[int, int], *, camera_height: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the ranges of a room at all pixels of a panorama, (H, W) float32, and their relative deviations."""
    rays = ray_grid(size_hw)
    ranges = room_ranges(room, rays, camera_height=camera_height).astype(np.float32)
    return ranges, _deviations(room, rays @ room.cam_from_level)


def _deviations(room: RoomOutline, level_rays: FloatArray) -> NDArray[np.float32]:
    """Return the relative deviations of the ranges of a room along rays (..., 3) of its level frame."""
    azimuth = np.degrees(np.arctan2(level_rays[..., 0], level_rays[..., 2])).round().astype(np.int64)
    is_closed = ~(room.probabilities >= _LEAST_PROBABILITY)[azimuth % len(room.distances)]
    return np.where(is_closed, np.float32(CLOSED_UNCERTAINTY), np.float32(ROOM_UNCERTAINTY))
