"""A room with a window, as one camera sees it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.structure.view import ScenePlane, plane_ranges
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.surfaces import Structure

SIZE = 256, 512
POSE = Rigid3(np.eye(3), np.zeros(3))
NORMALS = np.array([(0, 0, -1), (0, 0, 1), (-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0)], np.float64)
OFFSETS = np.array([-3.0, -2.0, -2.5, -2.5, -1.5, -1.2])
PLANES = [
    ScenePlane(normal, float(offset), 1.0, 0.002, is_level=bool(normal[1]))
    for normal, offset in zip(NORMALS, OFFSETS, strict=True)
]
RAYS = ray_grid(SIZE)
RANGES = np.array([plane_ranges(RAYS, np.zeros(3), normal=one.normal, offset=one.offset) for one in PLANES])
LABEL = np.nanargmin(RANGES, axis=0).astype(np.int16)
PLACES = RAYS * np.nanmin(RANGES, axis=0)[..., None]
PANE: Mask = (LABEL == 0) & (np.abs(PLACES[..., 0] - 0.3) < 0.7) & (np.abs(PLACES[..., 1] + 0.1) < 0.6)


def room(pane: NDArray[np.generic] | float) -> Picture:
    """Return a room with grey walls, and the grey level of a pane."""
    wall = 150 + 10 * NORMALS[LABEL, 0] - 20 * (LABEL > 3)
    bar = np.abs(PLACES[..., 0] - 0.3) < 0.03
    return np.repeat(np.where(PANE & ~bar, pane, wall)[..., None], 3, axis=2).astype(np.uint8)


def range_map(confidence: int) -> RangeMap:
    """Return the true ranges, with a confidence."""
    return RangeMap(np.nanmin(RANGES, axis=0).astype(np.float32), np.full(SIZE, confidence, np.uint8))


def structure() -> Structure:
    """Return the walls, the floor and the ceiling."""
    return Structure(NORMALS, OFFSETS, np.full(len(PLANES), 0.002), np.zeros(len(PLANES), np.int32))
