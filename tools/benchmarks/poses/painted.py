"""What the drawn houses have in common: their paint, surfaces within spheres, and the files of their pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3
from pano_mvs.scene.image_file import write_png
from pano_mvs.testing.room import Colors, albedo_at
from pano_mvs.testing.surfaces import Ball, Cuboid, Surface, Vector
from tests.synthetic.bounded import Bounded
from tests.synthetic.rod import Rod


@dataclass(frozen=True)
class Paint:
    """The texture "outdoor", or "weak" if it is plain, with a seed and an origin of its own.

    So it stays when other surfaces are left out, and can repeat elsewhere.
    """

    colors: Colors
    seed: int
    origin: Vector = (0.0, 0.0, 0.0)
    plain: bool = False

    def albedo(self, points: FloatArray, normals: FloatArray, *, footprint: FloatArray) -> FloatArray:
        """Return the colours (N, 3) of points (N, 3)."""
        del normals
        local = points - np.array(self.origin)
        return albedo_at(local, self.colors, "weak" if self.plain else "outdoor", seed=self.seed, footprint=footprint)


Painted = tuple[Surface, Paint]


def bounded(surface: Ball | Cuboid | Rod) -> Bounded:
    """Return a surface within a sphere, outside of which no ray needs to be tried."""
    if isinstance(surface, Ball):
        return Bounded(surface, surface.center, surface.radius)
    ends = (surface.low, surface.high) if isinstance(surface, Cuboid) else (surface.foot, surface.head)
    low, high = np.array(ends)
    x, y, z = (float(value) for value in 0.5 * (low + high))
    return Bounded(surface, (x, y, z), 0.5 * float(np.linalg.norm(high - low)) + getattr(surface, "radius", 0.0))


def write_views(
    folder: Path, truth: Mapping[str, Rigid3], view: Callable[[int, Rigid3], NDArray[np.uint8]]
) -> dict[str, Rigid3]:
    """Render the pictures that a folder does not have yet, and return the true cam_from_world of all, by name."""
    folder.mkdir(parents=True, exist_ok=True)
    for idx, (name, pose) in enumerate(truth.items()):
        if not (folder / name).is_file():
            write_png(folder.with_suffix(".part"), view(idx, pose))
            folder.with_suffix(".part").rename(folder / name)
    return dict(truth)
