"""Thin a cloud to one point per voxel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.scene import PointCloud

# Number of points that are collected before they are sorted into voxels; with fewer, voxels are sorted too often.
_MIN_WAITING = 1_000_000


def thin_by_voxels(cloud: PointCloud, voxel_size: float) -> PointCloud:
    """Thin a cloud to one point per occupied voxel, in the order in which voxels first appear.

    Positions and colours are averages over the voxel, weighted by the number of views; normals are averaged and
    normalised, or the first one if they cancel; the numbers of views and the confidences are maxima, the uncertainties
    minima.

    `cloud`: N points. `voxel_size`: edge of a voxel in scene units; voxels are aligned with the world's axes and its
    origin.

    Raises:
        UsageError: if the voxel size is not positive.
    """
    grid = VoxelGrid(voxel_size)
    grid.add(cloud)
    return grid.cloud()


@dataclass(frozen=True, slots=True, eq=False)
class _Voxels:
    """Voxels in the order in which they first appeared.

    `places`: (G, 3) int64. `sums`: (G, 10) of weights, and of weighted positions, normals and colours. `first_normals`:
    (G, 3) float32. `largest`: (G, 2) uint8 number of views and confidence. `uncertainties`: (G,) float32, the smallest
    of each voxel.
    """

    places: NDArray[np.int64]
    sums: NDArray[np.float64]
    first_normals: NDArray[np.float32]
    largest: NDArray[np.uint8]
    uncertainties: NDArray[np.float32]


class VoxelGrid:
    """Adds clouds one at a time, and keeps one point per occupied voxel; memory grows with the number of voxels."""

    def __init__(self, voxel_size: float) -> None:
        """Create an empty grid.

        Raises:
            UsageError: if the voxel size is not positive.
        """
        if not voxel_size > 0:
            raise UsageError(f"voxel_size must be positive, got {voxel_size}")
        self._voxel_size = voxel_size
        self._parts: list[_Voxels] = []
        self._has_confidence = True
        self._has_uncertainty = True

    def add(self, cloud: PointCloud) -> None:
        """Add the points of a cloud."""
        weight = np.maximum(cloud.view_counts, 1).astype(np.float64)[:, None]
        places = np.floor(cloud.points_in_world.astype(np.float64) / self._voxel_size).astype(np.int64)
        values = np.concatenate([cloud.points_in_world, cloud.normals_in_world, cloud.colors_rgb], axis=1, dtype=float)
        confidence = np.zeros_like(cloud.view_counts) if cloud.confidence is None else cloud.confidence
        largest = np.stack([cloud.view_counts, confidence], axis=1)
        uncertainty = np.zeros(len(cloud), np.float32) if cloud.uncertainty is None else cloud.uncertainty
        self._has_confidence &= cloud.confidence is not None
        self._has_uncertainty &= cloud.uncertainty is not None
        sums = np.concatenate([weight, weight * values], axis=1)
        self._parts.append(_merged([_Voxels(places, sums, cloud.normals_in_world, largest, uncertainty)]))
        waiting = sum(len(part.places) for part in self._parts[1:])
        if waiting > max(_MIN_WAITING, len(self._parts[0].places)):
            self._parts = [_merged(self._parts)]

    def cloud(self) -> PointCloud:
        """Return the points of all voxels."""
        empty = np.zeros((0, 3), np.float32)
        none = _Voxels(empty.astype(np.int64), np.zeros((0, 10)), empty, np.zeros((0, 2), np.uint8), empty[:, 0])
        voxels = self._parts[0] if len(self._parts) == 1 else _merged([none, *self._parts])
        mean = voxels.sums[:, 1:] / voxels.sums[:, :1]
        length = np.linalg.norm(mean[:, 3:6], axis=1, keepdims=True)
        normals = np.where(length > 0.1, mean[:, 3:6] / np.maximum(length, 0.1), voxels.first_normals)
        return PointCloud(
            points_in_world=mean[:, :3].astype(np.float32),
            normals_in_world=normals.astype(np.float32),
            colors_rgb=np.rint(mean[:, 6:]).astype(np.uint8),
            view_counts=voxels.largest[:, 0].copy(),
            confidence=voxels.largest[:, 1].copy() if self._has_confidence else None,
            uncertainty=voxels.uncertainties.copy() if self._has_uncertainty else None,
        )


def _merged(parts: list[_Voxels]) -> _Voxels:
    """Return the voxels of all parts without duplicates."""
    places = np.concatenate([part.places for part in parts])
    order = np.lexsort(places.T[::-1])  # stable: the first point of a voxel stays in front
    begins = np.ones(len(order), np.bool_)
    begins[1:] = (np.diff(places[order], axis=0) != 0).any(axis=1)
    starts = np.flatnonzero(begins)
    if not len(starts):
        return parts[0]
    first = order[starts]
    appearance = np.argsort(first, kind="stable")
    sums = np.concatenate([part.sums for part in parts])[order]
    largest = np.concatenate([part.largest for part in parts])[order]
    uncertainties = np.concatenate([part.uncertainties for part in parts])[order]
    return _Voxels(
        places[first[appearance]],
        np.add.reduceat(sums, starts, axis=0)[appearance],
        np.concatenate([part.first_normals for part in parts])[first[appearance]],
        np.maximum.reduceat(largest, starts, axis=0)[appearance],
        np.minimum.reduceat(uncertainties, starts)[appearance],
    )
