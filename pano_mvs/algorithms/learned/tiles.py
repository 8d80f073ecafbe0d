"""Level pinhole views around a panorama, in which the networks look for key points and match them."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pano_mvs.algorithms.learned.networks import TILE_PX
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import PinholeView, rotation_from_rotvec, rotation_from_two_vectors

_UP = np.array([0.0, -1.0, 0.0])


class Scale(NamedTuple):
    """Views of one size: their width and height in degrees, how many are in a row, and how far down the rows look."""

    fov_deg: float
    columns: int
    downwards_deg: tuple[float, ...]

    @property
    def views(self) -> int:
        """The number of views."""
        return self.columns * len(self.downwards_deg)

    @property
    def focal_px(self) -> float:
        """The focal length of a view."""
        return TILE_PX / 2 / float(np.tan(np.deg2rad(self.fov_deg) / 2))

    def level_tiles(self, up: FloatArray) -> tuple[PinholeView, ...]:
        """Return the views of a camera that sees the zenith in direction `up` (3,)."""
        level_from_cam = rotation_from_two_vectors(up, _UP)
        center = np.full(2, TILE_PX / 2)
        return tuple(
            PinholeView(side @ level_from_cam, self.focal_px, center, (TILE_PX, TILE_PX)) for side in _sides(self)
        )


SCALES = (Scale(60.0, 8, (-18.0, 18.0)), Scale(32.0, 12, (0.0,)))
"""The network finds the same key points only at about the same size, but a room looks two to four times as large from
within as through a door: the second scale shows it as large (see docs/learned.md)."""


@lru_cache
def _sides(scale: Scale) -> tuple[FloatArray, ...]:
    return tuple(
        rotation_from_rotvec(np.array([np.deg2rad(downwards), 0.0, 0.0]))
        @ rotation_from_rotvec(np.array([0.0, 2 * np.pi * number / scale.columns, 0.0]))
        for downwards in scale.downwards_deg
        for number in range(scale.columns)
    )
