"""Poses from AliceVision's JSON (`.sfm` or `.json`), which Meshroom's nodes exchange.

AliceVision's equirectangular camera maps a point to the angles atan2(x, z) and asin(y / |x|), of which the image
centre has both 0, so that its camera frame is x right, y down, z forward, as ours (`camera/Equirectangular.cpp`). A
pose holds the rotation of cam_from_world and the camera's centre: x_in_cam = R (x_in_world − c). Matrices are stored
by COLUMNS, and all numbers as strings (`sfmDataIO/jsonIO.hpp`).
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from posixpath import commonpath
from typing import Any

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.poses.json_files import number_array, require_distinct, rigid_from_arrays

_EQUIRECTANGULAR = "equirectangular"


def is_alicevision(data: Any) -> bool:
    """Return whether a JSON value looks like AliceVision's description of a scene."""
    return isinstance(data, dict) and {"version", "views", "intrinsics"} <= data.keys()


def alicevision_poses(data: dict[str, Any], path: Path) -> dict[str, Rigid3]:
    """Return the poses of all views that have one, by image path below the folder that all images share.

    Args:
        data: the contents of the file; see `is_alicevision`.
        path: the file, for error messages.

    Raises:
        InputError: if a value is invalid, or a camera is not equirectangular; it names the view or the pose.
    """
    cameras = {entry.get("intrinsicId"): entry for entry in _entries(data, "intrinsics", path)}
    placed = {entry.get("poseId"): entry.get("pose") for entry in _entries(data, "poses", path)}
    found: list[tuple[str, Rigid3]] = []
    for view in _entries(data, "views", path):
        if (pose := placed.get(view.get("poseId"))) is None:
            continue
        file = view.get("path")
        where = f"{path}: view {view.get('viewId')}"
        if not isinstance(file, str) or not PurePosixPath(file.replace("\\", "/")).name:
            raise InputError(f"{where}: key 'path' must be the path of the image, got {file!r}")
        kind = cameras.get(view.get("intrinsicId"), {}).get("type")
        if kind != _EQUIRECTANGULAR or "rigId" in view:
            camera = "part of a rig" if "rigId" in view else kind
            raise InputError(f"{where} ({file}): its camera is {camera}, expected one equirectangular camera")
        found.append((file.replace("\\", "/"), _pose(pose, f"{path}: pose {view['poseId']} ({file})")))
    require_distinct([name for name, _ in found], path)
    shared = _shared_folder([PurePosixPath(name) for name, _ in found])
    return {str(PurePosixPath(name).relative_to(shared)): pose for name, pose in found}


def _shared_folder(files: list[PurePosixPath]) -> PurePosixPath:
    if len({file.is_absolute() for file in files}) > 1:
        return PurePosixPath()
    return PurePosixPath(commonpath([str(file.parent) for file in files]))


def _entries(data: dict[str, Any], section: str, path: Path) -> list[dict[str, Any]]:
    entries = data.get(section, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: key {section!r} must be a list of objects, as AliceVision writes it")
    return entries


def _pose(value: Any, where: str) -> Rigid3:
    transform = value.get("transform") if isinstance(value, dict) else None
    if not isinstance(transform, dict):
        raise InputError(f"{where}: key 'pose' must hold a transform")
    by_columns = number_array(transform, "rotation", (9,), where=where).reshape(3, 3)
    center = number_array(transform, "center", (3,), where=where)
    return Rigid3.from_center(rigid_from_arrays(by_columns.T, center, where).rotation, center)
