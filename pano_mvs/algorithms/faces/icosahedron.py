"""Twenty overlapping tangent tiles, one for each face of an icosahedron.

A gnomonic (tangent plane) view of a small part of the sphere is an ordinary perspective image, to which planar
detectors can be applied without seam or pole. Great circles are straight in it, so the part of the sphere that is
nearest to a tile's centre is exactly a triangle: the face of the icosahedron (Eder et al., "Tangent Images for
Mitigating Spherical Distortion", 2020).
"""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import PinholeView

_MARGIN = 0.17  # in units of the focal length; required by detectors and descriptors beyond the face
_MIN_MARGIN_PX = 24


@cache
def face_centers() -> FloatArray:
    """Return the unit centres of the twenty faces, (20, 3); a direction belongs to the nearest one."""
    return np.array([triangle.mean(axis=0) / np.linalg.norm(triangle.mean(axis=0)) for triangle in _faces()])


@cache
def face_corners() -> FloatArray:
    """Return the unit corners of the twenty faces, (20, 3, 3): face, corner, axis."""
    return np.array(_faces())


def beyond_face_rad(bearings: FloatArray, face_idx: int) -> FloatArray:
    """Return by how many radians bearings (..., 3) are beyond the nearest edge of a face, (...,); negative inside."""
    centers = face_centers()
    across = centers - centers[face_idx]
    lengths = np.linalg.norm(across, axis=1)
    lengths[face_idx] = 1.0
    # The face's own centre gives 0, which would hide how far a bearing is inside the edges.
    beyond: FloatArray = np.delete(bearings @ (across / lengths[:, None]).T, face_idx, axis=-1).max(axis=-1)
    return beyond


def tangent_tiles(size_hw: tuple[int, int]) -> list[PinholeView]:
    """Return the twenty tiles for a panorama, at its own resolution at the equator (W / 2π px per radian)."""
    focal_px = size_hw[1] / (2 * np.pi)
    return [_tile(triangle, focal_px) for triangle in _faces()]


@cache
def _faces() -> tuple[FloatArray, ...]:
    """Return the corners (3, 3), unit vectors, of the twenty faces."""
    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([np.roll([0.0, a, b * golden], shift) for shift in range(3) for a in (-1, 1) for b in (-1, 1)])
    triples = [corners[list(triple)] for triple in combinations(range(12), 3)]
    faces = [t for t in triples if np.allclose([np.linalg.norm(t[i] - t[i - 1]) for i in range(3)], 2.0)]
    return tuple(face / np.linalg.norm(face[0]) for face in faces)


def _tile(triangle: FloatArray, focal_px: float) -> PinholeView:
    """Return the tile around a face, rotated so that one corner of the face is along the tile's y axis."""
    z = triangle.mean(axis=0) / np.linalg.norm(triangle.mean(axis=0))
    y = triangle[0] - (triangle[0] @ z) * z
    y /= np.linalg.norm(y)
    tile_from_cam = np.array([np.cross(y, z), y, z])
    in_tile = triangle @ tile_from_cam.T
    plane = in_tile[:, :2] / in_tile[:, 2:]
    margin = max(_MARGIN, _MIN_MARGIN_PX / focal_px)
    low, high = plane.min(axis=0) - margin, plane.max(axis=0) + margin
    width, height = np.ceil((high - low) * focal_px).astype(int)
    return PinholeView(tile_from_cam, focal_px, -low * focal_px, (int(height), int(width)))
