"""Level pinhole views around a panorama, in which the networks look for key points and match them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from pano_mvs.algorithms.learned.networks import TILE_PX
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import UP, PinholeView, rotation_from_rotvec, rotation_from_two_vectors

FOV_DEG = 60.0
_COLUMNS, _ELEVATIONS_DEG = 8, (-18.0, 18.0)
"""Of two sizes of views, these find twice as many true matches through doors as six of 80° on the horizon."""

FOCAL_PX = TILE_PX / 2 / float(np.tan(np.deg2rad(FOV_DEG) / 2))


def level_tiles(up: FloatArray) -> tuple[PinholeView, ...]:
    """Return two rows of views around the horizon of a camera that sees the zenith in direction `up` (3,)."""
    level_from_cam = rotation_from_two_vectors(up, UP)
    center = np.full(2, TILE_PX / 2)
    return tuple(PinholeView(side @ level_from_cam, FOCAL_PX, center, (TILE_PX, TILE_PX)) for side in _sides())


@lru_cache
def _sides() -> tuple[FloatArray, ...]:
    return tuple(
        rotation_from_rotvec(np.array([np.deg2rad(elevation), 0.0, 0.0]))
        @ rotation_from_rotvec(np.array([0.0, 2 * np.pi * number / _COLUMNS, 0.0]))
        for elevation in _ELEVATIONS_DEG
        for number in range(_COLUMNS)
    )
