"""Surfaces of the synthetic scenes, with ray intersections in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

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
        """Return the distance along each ray (inf: none) and the normal there: (N,) and (N, 3)."""


@dataclass(frozen=True)
class Cuboid:
    """An axis-aligned box, seen from outside (furniture) or from inside (the room itself)."""

    low: Vector
    high: Vector
    colors_rgb: tuple[Vector, Vector]

    def hit(self, origin: FloatArray, rays: FloatArray) -> Hit:
        """Return the distance along each ray (N, 3) from one origin (3,), and the normal there (slab method)."""
        along = np.ascontiguousarray(rays.T)  # one row for each axis
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low, to_high = ((np.array(corner) - origin)[:, None] / along for corner in (self.low, self.high))
        enters, leaves = np.minimum(to_low, to_high), np.maximum(to_low, to_high)
        if np.any(origin == self.low) or np.any(origin == self.high):  # 0 / 0 for rays within that face
            enters[np.isnan(enters)], leaves[np.isnan(leaves)] = -np.inf, np.inf
        near, far = enters.max(axis=0), leaves.min(axis=0)
        outside, met = near > 0, (near <= far) & (far > 0)
        rows = np.flatnonzero(met)
        axis = np.where(outside[rows], enters[:, rows].argmax(axis=0), leaves[:, rows].argmin(axis=0))
        normals = np.zeros_like(rays)
        normals[rows, axis] = -np.sign(rays[rows, axis])
        return np.where(met, np.where(outside, near, far), np.inf), normals


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
        miss_squared = np.sum((to_center - middle[:, None] * rays) ** 2, axis=1)
        half_chord = np.sqrt(np.maximum(self.radius**2 - miss_squared, 0))
        near, far = middle - half_chord, middle + half_chord
        distance = np.where(near > 0, near, far)
        distance = np.where((miss_squared < self.radius**2) & (far > 0), distance, np.inf)
        with np.errstate(invalid="ignore"):
            normals = (distance[:, None] * rays - to_center) / self.radius
        return distance, np.where(near[:, None] > 0, normals, -normals)


@dataclass(frozen=True)
class Quad:
    """A flat parallelogram, seen from either side."""

    corner: Vector
    edge_u: Vector
    edge_v: Vector
    colors_rgb: tuple[Vector, Vector]

    def hit(self, origin: FloatArray, rays: FloatArray) -> Hit:
        """Return the distance along each ray (N, 3) from one origin (3,), and the normal there."""
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
