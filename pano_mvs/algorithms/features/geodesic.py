"""A geodesic grid: the sphere in nearly equal hexagonal cells, in twenty overlapping charts.

Every face of an icosahedron is divided into a triangular lattice, n steps along an edge, so that each cell has six
neighbours at fixed steps (Zhao et al., "SPHORB", 2015, section 3). The usual grid is irregular at the twelve corners of
the icosahedron and bends at its edges. Here every face's lattice continues smoothly beyond the face instead, by the
size of a neighbourhood, so that no cell of a face has an irregular neighbourhood; a face owns the cells inside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import face_corners
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pad_panorama, pixel_from_ray

_PAD_PX = 4
_EDGE_RAD = float(np.arctan(2.0))  # angle between two neighbouring corners of an icosahedron
# Lattice steps (u, v) to the six neighbours, counter-clockwise; the axes include 60°.
NEIGHBOURS = np.array([[1, 0], [0, 1], [-1, 1], [-1, 0], [0, -1], [1, -1]])


@dataclass(frozen=True)
class GeodesicGrid:
    """Twenty triangular lattices that cover the sphere.

    A position is a face and lattice coordinates (u, v), with u, v >= 0 and u + v <= steps inside the face; cell (u, v)
    of face f is element [f, v + margin, u + margin] of an array (20, side, side).

    Attributes:
        steps: number of lattice steps along an edge.
        margin: number of cells by which each lattice extends beyond its face.
    """

    steps: int
    margin: int

    @property
    def side(self) -> int:
        """Number of cells along either axis of a face's array."""
        return self.steps + 1 + 2 * self.margin

    @property
    def spacing_rad(self) -> float:
        """Mean angle between neighbouring cells, that of 10 n² hexagons covering the sphere."""
        return float(np.sqrt(4 * np.pi / (10 * self.steps**2) * 2 / np.sqrt(3)))

    @cached_property
    def ring_offsets(self) -> NDArray[np.int64]:
        """Offsets in a flat face array of the 18 cells at three steps, in order around the centre."""
        return self.flat_offsets(hexagon_ring(3))

    def flat_offsets(self, cells_uv: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the offsets of lattice steps (..., 2) in a flat face array."""
        offsets: NDArray[np.int64] = cells_uv[..., 1] * self.side + cells_uv[..., 0]
        return offsets

    def bearings(self, face_idx: NDArray[np.integer], places_uv: FloatArray) -> FloatArray:
        """Return the unit bearings (N, 3) of positions (N, 2) on faces (N,), in the camera frame.

        With barycentric coordinates b of the lattice, the direction is Σ sin(b_k θ) V_k over the face's corners, where
        θ is the angle of an edge. Along an edge this is the great circle at constant speed.
        """
        rays = np.einsum("nk,nkj->nj", self._weights(places_uv), face_corners()[face_idx])
        unit: FloatArray = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def lattice_from_tangent(self, face_idx: NDArray[np.integer], places_uv: FloatArray) -> FloatArray:
        """Return (N, 2, 2), from a small tangent-plane step in units of `spacing_rad` to lattice steps.

        The tangent plane's axes are the lattice's u axis e and bearing × e, right-handed on every face.
        """
        bearing = self.bearings(face_idx, places_uv)
        steps = [
            self.bearings(face_idx, places_uv + half) - self.bearings(face_idx, places_uv - half)
            for half in (np.array([0.5, 0.0]), np.array([0.0, 0.5]))
        ]
        first = steps[0] - np.sum(steps[0] * bearing, axis=1, keepdims=True) * bearing
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        axes = np.stack([first, np.cross(bearing, first)], axis=1)
        tangent_from_lattice = axes @ np.stack(steps, axis=2) / self.spacing_rad
        return np.asarray(np.linalg.inv(tangent_from_lattice), np.float64)

    def sample(self, panorama: NDArray[np.uint8], *, interpolation: int = cv2.INTER_CUBIC) -> NDArray[np.uint8]:
        """Return a panorama (H, W) uint8 sampled at all cells, (20, side, side), across seam and poles."""
        height, width = panorama.shape
        first_map, second_map = _sampling_maps(self, (height, width))
        padded = pad_panorama(panorama, _PAD_PX)
        sampled = cv2.remap(padded, first_map, second_map, interpolation)
        return np.asarray(sampled, np.uint8).reshape(20, self.side, self.side)

    def _weights(self, places_uv: FloatArray) -> FloatArray:
        u, v = places_uv[..., 0] / self.steps, places_uv[..., 1] / self.steps
        return np.sin(_EDGE_RAD * np.stack([1 - u - v, u, v], axis=-1)).astype(np.float64)


def hexagon_ring(radius: int) -> NDArray[np.int64]:
    """Return the lattice steps (6 radius, 2) to the cells at distance `radius`, in order around the centre."""
    sides = [radius * NEIGHBOURS[k] + step * NEIGHBOURS[(k + 2) % 6] for k in range(6) for step in range(radius)]
    return np.array(sides, np.int64)


def plane_from_lattice(cells_uv: NDArray[np.generic]) -> FloatArray:
    """Return lattice steps (..., 2) as steps in the plane of the undistorted lattice, neighbours at distance 1."""
    plane: FloatArray = cells_uv @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    return plane


@lru_cache(maxsize=16)
def _sampling_maps(grid: GeodesicGrid, size_hw: tuple[int, int]) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Return the position of every cell in a padded panorama, in OpenCV's fixed-point form (1/32 pixel)."""
    steps = np.arange(-grid.margin, grid.steps + grid.margin + 1, dtype=np.float64)
    v, u = np.meshgrid(steps, steps, indexing="ij")
    weights = grid._weights(np.stack([u, v], axis=-1))
    maps = []
    for corners in face_corners():
        # OpenCV puts (0, 0) at the first pixel's centre.
        pixels = pixel_from_ray(weights @ corners, size_hw) + (_PAD_PX - 0.5)
        maps.append(pixels.astype(np.float32))
    stacked = np.concatenate(maps)
    first_map, second_map = cv2.convertMaps(stacked, None, cv2.CV_16SC2)
    first_map.setflags(write=False)
    second_map.setflags(write=False)
    return first_map, second_map
