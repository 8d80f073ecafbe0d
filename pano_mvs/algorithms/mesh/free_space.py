"""Removal of the parts of a surface through which panoramas look."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pixel_from_ray
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

# Ranges of one surface differ by less than this share; beyond the second share, the panorama sees something behind it.
_CONFIRMS, _SEES_THROUGH = 0.03, 0.08
_MIN_VIEWS = 2


class FreeSpace:
    """Counts how many panoramas confirm each vertex of a mesh, and how many look through it."""

    def __init__(self, vertices_in_world: NDArray[np.float32]) -> None:
        """Start without panoramas."""
        self._vertices = vertices_in_world
        self._confirmed = np.zeros(len(vertices_in_world), np.uint8)
        self._through = np.zeros(len(vertices_in_world), np.uint8)
        self._sky = np.zeros(len(vertices_in_world), np.bool_)

    def add(self, range_map: RangeMap, cam_from_world: Rigid3, valid: NDArray[np.bool_]) -> None:
        """Compare the vertices with the ranges of a panorama, without masked pixels.

        Args:
            range_map: (H, W) ranges; weak and filled ones confirm vertices but do not contradict them.
            cam_from_world: pose of the panorama.
            valid: (H, W) pixels that are not masked.

        Raises:
            UsageError: if the sizes differ.
        """
        if valid.shape != range_map.range.shape:
            raise UsageError(f"a mask of {valid.shape} for ranges of {range_map.range.shape}")
        points = cam_from_world.apply(self._vertices)
        height, width = range_map.range.shape
        at = np.floor(pixel_from_ray(points, (height, width))).astype(np.int64)
        row, column = np.minimum(at[:, 1], height - 1), at[:, 0] % width
        ratio = range_map.range[row, column] / np.linalg.norm(points, axis=1)
        shown = valid[row, column]
        sure = shown & (range_map.confidence[row, column] >= CONSISTENT_CONFIDENCE[0])
        with np.errstate(invalid="ignore"):
            self._confirmed += shown & (np.abs(ratio - 1) <= _CONFIRMS) & (self._confirmed < 255)
            self._through += sure & (ratio > 1 + _SEES_THROUGH) & (self._through < 255)
        if range_map.sky is not None:
            self._sky |= shown & range_map.sky[row, column]

    def free(self) -> NDArray[np.bool_]:
        """Return the vertices (V,) that no panorama confirms, and that two look through or one sees as sky."""
        return np.asarray((self._confirmed == 0) & ((self._through >= _MIN_VIEWS) | self._sky))
