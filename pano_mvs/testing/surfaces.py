"""Surfaces of the synthetic scenes, with ray intersections in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray

Vector: TypeAlias = tuple[float, float, float]
Hit: TypeAlias = tuple[FloatArray, FloatArray]


class Surface(Protocol):
    """A surface that rays can intersect.

    Attributes:
        colors_rgb: the two colours in [0, 1] between which its texture varies.
    """

    @property
    def colors_rgb(self) -> tuple[Vector, Vector]:
        """The two colours between which the texture varies."""

    def hit(self, origin: FloatArray, rays: FloatArray) -> Hit:
        """Return the distance along each unit ray (inf: none) and the normal there: (N,) and (N, 3)."""


@dataclass(frozen=True)
class Cuboid:
    """An axis-aligned box, seen from outside (furniture) or from inside (the room itself)."""

    low: Vector
    high: Vector
    colors_rgb: tuple[Vector, Vector]

    def hit(self, origin: FloatArray, rays: FloatArray) -> Hit:
        """Return the distance along each unit ray (N, 3) from one origin (3,), and the normal there (slab method)."""
        along = np.ascontiguousarray(rays.T)  # one row for each axis
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low, to_high = ((np.array(corner) - origin)[:, None] / along for corner in (self.low, self.high))
        enters, leaves = np.minimum(to_low, to_high), np.maximum(to_low, to_high)
        if np.any(origin == self.low) or np.any(origin == self.high):  # 0 / 0 for rays within that face
            enters[np.isnan(enters)], leaves[np.isnan(leaves)] = -np.inf, np.inf
        near, far = enters.max(axis=0), leaves.min(axis=0)
        outside, met = near > 0, (near <= far) & (far > 0)
        normals = np.zeros_like(rays)
        for rows, axis in (
            (entered := np.flatnonzero(met & outside), enters[:, entered].argmax(axis=0)),
            (left := np.flatnonzero(met & ~outside), leaves[:, left].argmin(axis=0)),
        ):
            normals[rows, axis] = -np.sign(rays[rows, axis])
        return np.where(met, np.where(outside, near, far), np.inf), normals

    def towards(self, origin: FloatArray, rays: FloatArray) -> NDArray[np.int64] | None:
        """Return which rays (N, 3) come near; None for all."""
        low, high = np.array(self.low), np.array(self.high)
        return _near((low + high) / 2 - origin, rays, float(np.linalg.norm(high - low)) / 2)


def sum_of_three(vectors: FloatArray) -> FloatArray:
    """Return the sums (N,) of vectors (N, 3), the digits of `np.sum`, which takes several times as long."""
    x, y, z = vectors.T
    return np.asarray(x + y + z)


def _near(to_center: FloatArray, rays: FloatArray, radius: float) -> NDArray[np.int64] | None:
    """Return which unit rays (N, 3) may meet what is within a radius of a point; None for all."""
    distance = float(np.linalg.norm(to_center))
    if distance <= radius:
        return None
    return np.flatnonzero(rays @ (to_center / distance) > np.sqrt(1 - (radius / distance) ** 2) - 1e-6)


@dataclass(frozen=True)
class Ball:
    """A sphere, seen from outside or from inside."""

    center: Vector
    radius: float
    colors_rgb: tuple[Vector, Vector]

    def hit(self, origin: FloatArray, rays: FloatArray) -> Hit:
        """Return the distance along each unit ray (N, 3) from one origin (3,), and the normal there."""
        to_center = np.array(self.center) - origin
        middle = rays @ to_center
        miss_squared = sum_of_three((to_center - middle[:, None] * rays) ** 2)
        half_chord = np.sqrt(np.maximum(self.radius**2 - miss_squared, 0))
        near, far = middle - half_chord, middle + half_chord
        distance = np.where(near > 0, near, far)
        distance = np.where((miss_squared < self.radius**2) & (far > 0), distance, np.inf)
        with np.errstate(invalid="ignore"):
            normals = (distance[:, None] * rays - to_center) / self.radius
        return distance, np.where(near[:, None] > 0, normals, -normals)

    def towards(self, origin: FloatArray, rays: FloatArray) -> NDArray[np.int64] | None:
        """Return which rays (N, 3) come near; None for all."""
        return _near(np.array(self.center) - origin, rays, self.radius)


@dataclass(frozen=True)
class Quad:
    """A flat parallelogram, seen from either side."""

    corner: Vector
    edge_u: Vector
    edge_v: Vector
    colors_rgb: tuple[Vector, Vector]

    def hit(self, origin: FloatArray, rays: FloatArray) -> Hit:
        """Return the distance along each unit ray (N, 3) from one origin (3,), and the normal there."""
        u, v = np.array(self.edge_u), np.array(self.edge_v)
        normal = np.cross(u, v)
        area_squared = normal @ normal
        to_corner = np.array(self.corner) - origin
        along = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (to_corner @ normal) / along
            inside = distance[:, None] * rays - to_corner
            share_u = inside @ np.cross(v, normal) / area_squared
            share_v = inside @ np.cross(normal, u) / area_squared
        met = (distance > 0) & (share_u >= 0) & (share_u <= 1) & (share_v >= 0) & (share_v <= 1)
        unit = normal / np.sqrt(area_squared)
        return np.where(met, distance, np.inf), -np.sign(along)[:, None] * unit

    def towards(self, origin: FloatArray, rays: FloatArray) -> NDArray[np.int64] | None:
        """Return which rays (N, 3) come near; None for all."""
        u, v = np.array(self.edge_u), np.array(self.edge_v)
        radius = max(float(np.linalg.norm(diagonal)) for diagonal in (u + v, u - v)) / 2
        return _near(np.array(self.corner) + (u + v) / 2 - origin, rays, radius)
