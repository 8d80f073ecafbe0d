"""Poses from OpenSfM's reconstruction.json.

OpenSfM's spherical camera maps longitude and latitude to u = lon / 2π, v = −lat / 2π about the image centre, so
that its camera frame is x right, y down, z forward, as ours. A shot's rotation is the angle-axis vector of
cam_from_world, and x_in_cam = R x_in_world + t.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.io.poses.json_files import number_array, require_distinct, rigid_from_arrays

_SPHERICAL = ("spherical", "equirectangular")


def is_opensfm(data: Any) -> bool:
    """Return whether a JSON value looks like the list of reconstructions that OpenSfM writes."""
    return isinstance(data, list) and bool(data) and all(isinstance(item, dict) and "shots" in item for item in data)


def opensfm_poses(data: list[dict[str, Any]], path: Path) -> tuple[dict[str, Rigid3], bool]:
    """Return the poses of the reconstruction with the most shots, by image name, and whether lengths are metres.

    The world is east, north, up in metres about `reference_lla`. Without GPS positions, OpenSfM writes a reference at
    latitude and longitude 0, and the unit of length is arbitrary.

    Args:
        data: the contents of the file; see `is_opensfm`.
        path: the file, for error messages.

    Raises:
        InputError: if a value is invalid; it names the shot and the key.
    """
    for item in data:
        if not isinstance(item.get("cameras"), dict) or not isinstance(item["shots"], dict):
            raise InputError(f"{path}: 'cameras' and 'shots' must be objects by name")
    largest = max(data, key=lambda item: len(item["shots"]))
    cameras, shots = largest["cameras"], largest["shots"]
    poses = {name: _pose(shot, cameras, f"{path}: shot {name!r}") for name, shot in shots.items()}
    require_distinct(list(poses), path)
    reference = largest.get("reference_lla")
    somewhere = isinstance(reference, dict) and bool(reference.get("latitude") or reference.get("longitude"))
    return poses, somewhere


def _pose(shot: Any, cameras: dict[str, Any], where: str) -> Rigid3:
    if not isinstance(shot, dict):
        raise InputError(f"{where}: expected an object, got {type(shot).__name__}")
    camera = cameras.get(str(shot.get("camera", "")))
    projection = camera.get("projection_type") if isinstance(camera, dict) else None
    if projection not in _SPHERICAL:
        raise InputError(
            f"{where}: its camera's projection_type is {projection}, expected spherical. Only panoramas can be used"
        )
    rotvec, translation = (number_array(shot, key, (3,), where=where) for key in ("rotation", "translation"))
    if not np.isfinite(rotvec).all():
        raise InputError(f"{where}: key 'rotation' holds NaN or infinite numbers")
    return rigid_from_arrays(rotation_from_rotvec(rotvec), translation, where)
