"""Poses from openMVG's sfm_data.json.

openMVG's spherical camera maps a bearing (cos lat sin lon, −sin lat, cos lat cos lon) to u = lon / 2π, v = −lat / 2π
about the image centre in image widths, so that its camera frame is x right, y down, z forward, as ours. A pose holds
the rotation of cam_from_world by rows, and the camera's centre: x_in_cam = R (x_in_world − c).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.poses.json_files import number_array, require_distinct, rigid_from_arrays

_SPHERICAL = "spherical"


def is_openmvg(data: Any) -> bool:
    """Return whether a JSON value looks like openMVG's description of a scene."""
    return isinstance(data, dict) and {"views", "intrinsics", "extrinsics"} <= data.keys()


def openmvg_poses(data: dict[str, Any], path: Path) -> dict[str, Rigid3]:
    """Return the poses of all views that have one, by image name.

    Args:
        data: the contents of the file; see `is_openmvg`.
        path: the file, for error messages.

    Raises:
        InputError: if a value is invalid, or a camera is not spherical; it names the view or the pose.
    """
    cameras = _by_key(data, "intrinsics", path)
    extrinsics = _by_key(data, "extrinsics", path)
    names: list[str] = []
    poses: dict[str, Rigid3] = {}
    # Views that share a camera class name it once and refer to it by number afterwards.
    kinds = {
        one.get("polymorphic_id"): one["polymorphic_name"] for one in cameras.values() if "polymorphic_name" in one
    }
    for key, view in _by_key(data, "views", path).items():
        where = f"{path}: view {key}"
        about = _inner(view, where)
        pose = extrinsics.get(about.get("id_pose"))
        if pose is None:
            continue
        name = about.get("filename")
        if not isinstance(name, str) or not name:
            raise InputError(f"{where}: key 'filename' must be the name of the image, got {name!r}")
        camera = cameras.get(about.get("id_intrinsic"), {})
        kind = camera.get("polymorphic_name", kinds.get(_class_of(camera)))
        if kind != _SPHERICAL:
            raise InputError(f"{where} ({name}): its camera is {kind}, expected spherical. Only panoramas can be used")
        folder = str(about.get("local_path") or "").replace("\\", "/").strip("/")
        names.append(f"{folder}/{name}" if folder else name)
        poses[names[-1]] = _pose(pose, f"{path}: pose {about['id_pose']} ({name})")
    require_distinct(names, path)
    return poses


def _by_key(data: dict[str, Any], section: str, path: Path) -> dict[Any, dict[str, Any]]:
    """Return the values of a map that is stored as a list of keys and values."""
    entries = data[section]
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict) and isinstance(entry.get("key"), int) and isinstance(entry.get("value"), dict)
        for entry in entries
    ):
        raise InputError(f"{path}: key {section!r} must be a list of keys and values, as openMVG writes it")
    return {entry["key"]: entry["value"] for entry in entries}


def _inner(view: dict[str, Any], where: str) -> dict[str, Any]:
    wrapper = view.get("ptr_wrapper")
    about = wrapper.get("data") if isinstance(wrapper, dict) else None
    if not isinstance(about, dict):
        raise InputError(f"{where}: key 'ptr_wrapper' must hold the data of the view")
    # Views with a prior of the position hold those of an ordinary view inside.
    inner = about.get("value0") if "filename" not in about else about
    return inner if isinstance(inner, dict) else about


def _class_of(camera: dict[str, Any]) -> int:
    """Return the number of a camera's class; the highest bit marks its first mention."""
    number = camera.get("polymorphic_id")
    return number | 1 << 31 if isinstance(number, int) else -1


def _pose(value: dict[str, Any], where: str) -> Rigid3:
    rotation, center = (
        number_array(value, "rotation", (3, 3), where=where),
        number_array(value, "center", (3,), where=where),
    )
    checked = rigid_from_arrays(rotation, center, where)
    return Rigid3.from_center(checked.rotation, center)
