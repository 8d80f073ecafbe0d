"""A round rod, a surface of synthetic scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.testing.surfaces import Hit, Vector


@dataclass(frozen=True)
class Rod:
    """The surface of a round rod between two points, seen from outside or from inside; its ends are open."""

    foot: Vector
    head: Vector
    radius: float
    colors_rgb: tuple[Vector, Vector]

    def hit(self, origin: FloatArray, rays: FloatArray) -> Hit:
        """Return the distance along each ray (N, 3) from one origin (3,), and the normal there."""
        axis = np.array(self.head) - self.foot
        length = float(np.linalg.norm(axis))
        axis = axis / length
        to_origin = origin - np.array(self.foot)
        along_ray, along_origin = rays @ axis, float(to_origin @ axis)
        # Perpendicular to the axis, the rod is a circle.
        across, start = rays - along_ray[:, None] * axis, to_origin - along_origin * axis
        a, b = np.sum(across**2, axis=1), across @ start
        root = b**2 - a * (start @ start - self.radius**2)
        distance, normals = np.full(len(rays), np.inf), np.zeros_like(rays)
        with np.errstate(divide="ignore", invalid="ignore"):
            for sign in (-1.0, 1.0):
                to_wall = (-b + sign * np.sqrt(root)) / a
                place = along_origin + to_wall * along_ray
                met = (to_wall > 0) & (to_wall < distance) & (place >= 0) & (place <= length)
                distance[met] = to_wall[met]
                normals[met] = -sign * (start + to_wall[met, None] * across[met]) / self.radius
        return distance, normals
