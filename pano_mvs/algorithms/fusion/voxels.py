"""Thin a cloud so that no voxel holds more than one point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.scene import PointCloud


def thin_by_voxels(cloud: PointCloud, voxel_size: float) -> PointCloud:
    """Return a cloud with one point for each occupied voxel, in the order in which voxels first appear.

    Positions and colours are averages over the voxel, weighted by the number of views; normals are averaged and
    normalised, or the first one where they cancel; the number of views is the largest.

    Args:
        cloud: N points.
        voxel_size: edge of a voxel in scene units; voxels are aligned with the world's axes and its origin.

    Raises:
        UsageError: if the voxel size is not positive.
    """
    if not voxel_size > 0:
        raise UsageError(f"voxel_size must be positive, got {voxel_size}")
    voxels = np.floor(cloud.points_in_world.astype(np.float64) / voxel_size).astype(np.int64)
    _, first, voxel_of_point = np.unique(voxels, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    group = rank[voxel_of_point.reshape(-1)]
    weight = np.maximum(cloud.view_counts, 1).astype(np.float64)
    counts = np.zeros(len(order), np.uint8)
    np.maximum.at(counts, group, cloud.view_counts)
    normals = _mean(cloud.normals_in_world, group, weight)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    firsts = cloud.normals_in_world[first[order]]
    return PointCloud(
        points_in_world=_mean(cloud.points_in_world, group, weight).astype(np.float32),
        normals_in_world=np.where(length > 0.1, normals / np.maximum(length, 0.1), firsts).astype(np.float32),
        colors_rgb=np.rint(_mean(cloud.colors_rgb, group, weight)).astype(np.uint8),
        view_counts=counts,
    )


def _mean(
    values: NDArray[np.float32] | NDArray[np.uint8], group: NDArray[np.int64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the weighted mean, (G, 3), of the values, (N, 3), of each group."""
    count = int(group.max(initial=-1)) + 1
    total = np.bincount(group, weight, count)
    sums = [np.bincount(group, weight * values[:, axis], count) for axis in range(3)]
    return np.stack(sums, axis=1) / total[:, None]
