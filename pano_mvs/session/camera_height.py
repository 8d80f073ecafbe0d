"""The height of the cameras above the floor in the fused cloud, from which people can guess the scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.floor_plan.plan_grid import find_storeys
from pano_mvs.scene import PointCloud, Poses
from pano_mvs.scene.upright import world_up, z_up_from_world

PLAUSIBLE_HEIGHT_M = 1.6
"""A usual height of a camera on a tripod or a stick."""

_BLOCKS, _BLOCK_POINTS = 300, 1000
_MIN_POINTS = 1000


def camera_height(poses: Poses, cloud: PointCloud) -> float | None:
    """Return the median height of the cameras above their floor, in scene units; None if no floor was found.

    With several storeys, it is the height on the one with the most cameras.

    Args:
        poses: of one group.
        cloud: of the same group.
    """
    if not poses.names or len(cloud) < _MIN_POINTS:
        return None
    turn = z_up_from_world(world_up(poses))
    chosen = _sample(len(cloud))
    heights = cloud.points_in_world[chosen].astype(np.float64) @ turn[2]
    ups = cloud.normals_in_world[chosen].astype(np.float64) @ turn[2]
    centers = poses.centers @ turn[2]
    storeys = [storey for storey in find_storeys(heights, ups, centers) if storey.has_floor]
    if not storeys:
        return None
    largest = max(storeys, key=lambda storey: len(storey.cameras))
    height = float(np.median(centers[list(largest.cameras)])) - largest.floor
    return height if height > 0 else None


def _sample(count: int) -> NDArray[np.intp] | slice:
    """Return evenly spaced blocks of points, so that little of a memory-mapped cloud is read."""
    if count <= _BLOCKS * _BLOCK_POINTS:
        return slice(None)
    starts = np.linspace(0, count - _BLOCK_POINTS, _BLOCKS).astype(np.intp)
    return np.asarray(starts[:, None] + np.arange(_BLOCK_POINTS), np.intp).ravel()


def height_note(height: float) -> str:
    """Return what a run says about its unit if nothing states the scale."""
    return (
        f"lengths are in scene units: the cameras are {height:.3g} units above the floor. If that was "
        f"{PLAUSIBLE_HEIGHT_M:g} m, one unit is {PLAUSIBLE_HEIGHT_M / height:.3g} m. To use metres, measure a distance "
        "or a height: pano-mvs scale --help"
    )
