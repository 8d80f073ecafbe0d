"""A surface within a bounding sphere, for scenes with hundreds of surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.testing.surfaces import Hit, Surface, Vector


@dataclass(frozen=True)
class Bounded:
    """A surface within a bounding sphere, so that only rays towards the sphere are tested."""

    surface: Surface
    center: Vector
    radius: float

    @property
    def colors_rgb(self) -> tuple[Vector, Vector]:
        """The two colours between which the surface's texture varies."""
        return self.surface.colors_rgb

    def hit(self, origin: FloatArray, rays: FloatArray) -> Hit:
        """Return the distance along each unit ray (N, 3) from one origin (3,), and the normal there."""
        distance, normals, towards = np.full(len(rays), np.inf), np.zeros_like(rays), self.towards(origin, rays)
        distance[towards], normals[towards] = self.surface.hit(origin, rays[towards])
        return distance, normals

    def towards(self, origin: FloatArray, rays: FloatArray) -> NDArray[np.int64]:
        """Return the positions, ascending, of the unit rays (N, 3) from one origin (3,) that intersect the sphere."""
        to_center = np.array(self.center) - origin
        apart = float(np.linalg.norm(to_center))
        if apart <= self.radius:
            return np.arange(len(rays))
        least = np.sqrt(1 - (self.radius / apart) ** 2) - 1e-9
        return np.flatnonzero(rays @ (to_center / apart) >= least)
