"""Poses in the JSON files of openMVG, AliceVision and OpenSfM.

openMVG's spherical camera maps a bearing (cos lat sin lon, −sin lat, cos lat cos lon) to u = lon / 2π, v = −lat / 2π
about the image centre in image widths, so that its camera frame is x right, y down, z forward, as ours. A pose holds
the rotation of cam_from_world by rows, and the camera's centre: x_in_cam = R (x_in_world − c).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from posixpath import commonpath
from typing import Any

import numpy as np

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, pixel_from_ray, rotation_from_rotvec
from pano_mvs.io.poses.json_files import (
    FilePoses,
    FoundCamera,
    image_name,
    number_array,
    rigid_from_arrays,
)
from pano_mvs.scene.poses import Poses

_SPHERICAL = "spherical"
_NEW, _PLAIN = 1 << 31, 1 << 30  # of cereal: the first mention of a pointer or class; an object of the base class


def openmvg_poses(data: dict[str, Any], path: Path) -> FilePoses:
    """Return the poses of all views with a spherical camera that have one, by image name.

    Raises:
        InputError: if a value is invalid, or no camera is spherical; it names the view or the pose.
    """
    cameras = _by_key(data, "intrinsics", path)
    extrinsics = _by_key(data, "extrinsics", path)
    found: list[FoundCamera] = []
    # Views that share a camera class name it once and refer to it by number afterwards.
    kinds = {
        str(one.get("polymorphic_id")): one["polymorphic_name"] for one in cameras.values() if "polymorphic_name" in one
    }
    for key, view in _by_key(data, "views", path).items():
        where = f"{path}: view {key}"
        about = _inner(view, where)
        pose = extrinsics.get(str(about.get("id_pose")))
        if pose is None:
            continue
        name = image_name(about, "filename", where)
        camera = cameras.get(str(about.get("id_intrinsic")), {})
        number = camera.get("polymorphic_id")
        kind = camera.get("polymorphic_name", kinds.get(str(number | _NEW) if isinstance(number, int) else ""))
        folder = str(about.get("local_path") or "").replace("\\", "/").strip("/")
        read = partial(_pose, pose, f"{path}: pose {about['id_pose']} ({name})")
        full_name = f"{folder}/{name}" if folder else name
        found.append(FoundCamera(full_name, f"{where} ({name})", kind, _SPHERICAL, read))
    return FilePoses.of_cameras(found, path)


def _by_key(data: dict[str, Any], section: str, path: Path) -> dict[str, dict[str, Any]]:
    """Return the values of a map that is stored as a list of keys, here as text, and values."""
    entries = data[section]
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict) and isinstance(entry.get("key"), int) and isinstance(entry.get("value"), dict)
        for entry in entries
    ):
        raise InputError(f"{path}: key {section!r} must be a list of keys and values, as openMVG writes it")
    return {str(entry["key"]): entry["value"] for entry in entries}


def _inner(view: dict[str, Any], where: str) -> dict[str, Any]:
    wrapper = view.get("ptr_wrapper")
    about = wrapper.get("data") if isinstance(wrapper, dict) else None
    if not isinstance(about, dict):
        raise InputError(f"{where}: key 'ptr_wrapper' must hold the data of the view")
    # Views with a prior of the position hold those of an ordinary view inside.
    inner = about.get("value0") if "filename" not in about else about
    return inner if isinstance(inner, dict) else about


def _pose(value: dict[str, Any], where: str) -> Rigid3:
    rotation = number_array(value, "rotation", (3, 3), where=where)
    center = number_array(value, "center", (3,), where=where)
    return Rigid3.from_center(rigid_from_arrays(rotation, center, where).rotation, center)


def write_openmvg(path: Path, poses: Poses, sizes_hw: Mapping[str, tuple[int, int]]) -> None:
    """Write poses of one group with their points and tracks, as openMVG's `Save` (cereal's JSON archive) does.

    The world is that of the poses. Pixels follow openMVG's spherical camera: those of this package.
    """
    sizes = list(dict.fromkeys(sizes_hw[name] for name in poses.names))
    views, extrinsics = [], []
    for number, name in enumerate(poses.names):
        folder, _, file = name.rpartition("/")
        height, width = sizes_hw[name]
        about = {"local_path": folder, "filename": file, "width": width, "height": height}
        ids = {"id_view": number, "id_intrinsic": sizes.index((height, width)), "id_pose": number}
        views.append(_entry(number, {"polymorphic_id": _PLAIN, **_pointer(number, about | ids)}))
        pose = {"rotation": poses.rotations[number].tolist(), "center": poses.centers[number].tolist()}
        extrinsics.append(_entry(number, pose))
    intrinsics = []
    for number, (height, width) in enumerate(sizes):
        # The first object of a class states its name; later ones refer to it by number.
        kind = {"polymorphic_id": 1} if number else {"polymorphic_id": _NEW | 1, "polymorphic_name": _SPHERICAL}
        camera = {"value0": {"width": width, "height": height}}
        intrinsics.append(_entry(number, {**kind, **_pointer(len(views) + number, camera)}))
    document = {
        "sfm_data_version": "0.3",
        "root_path": "",
        "views": views,
        "intrinsics": intrinsics,
        "extrinsics": extrinsics,
        "structure": _structure(poses, sizes_hw),
        "control_points": [],
    }
    path.write_text(json.dumps(document, indent=1), encoding="utf-8")


def _structure(poses: Poses, sizes_hw: Mapping[str, tuple[int, int]]) -> list[dict[str, Any]]:
    """Return the points with the pixels at which images see them."""
    pixels = np.zeros((len(poses.track_image_idx), 2))
    for number, name in enumerate(poses.names):
        seen = poses.track_image_idx == number
        pixels[seen] = pixel_from_ray(poses.track_bearings[seen], sizes_hw[name])
    seen_by: list[list[dict[str, Any]]] = [[] for _ in poses.points_in_world]
    for number in np.lexsort((poses.track_image_idx, poses.track_point_idx)):
        at = {"id_feat": int(number), "x": pixels[number].tolist()}
        seen_by[poses.track_point_idx[number]].append(_entry(int(poses.track_image_idx[number]), at))
    return [
        _entry(number, {"X": point.tolist(), "observations": seen})
        for number, (point, seen) in enumerate(zip(poses.points_in_world, seen_by, strict=True))
    ]


def _entry(key: int, value: dict[str, Any]) -> dict[str, Any]:
    return {"key": key, "value": value}


def _pointer(number: int, data: dict[str, Any]) -> dict[str, Any]:
    return {"ptr_wrapper": {"id": _NEW | (number + 1), "data": data}}


def alicevision_poses(data: dict[str, Any], path: Path) -> FilePoses:
    """Return the poses of all panoramas that have one, by image path below the folder that they share.

    Raises:
        InputError: if a value is invalid, or no camera is equirectangular; it names the view or the pose.
    """
    cameras = {str(entry.get("intrinsicId")): entry for entry in _entries(data, "intrinsics", path)}
    placed = {str(entry.get("poseId")): entry.get("pose") for entry in _entries(data, "poses", path)}
    found: list[FoundCamera] = []
    for view in _entries(data, "views", path):
        if (pose := placed.get(str(view.get("poseId")))) is None:
            continue
        where = f"{path}: view {view.get('viewId')}"
        file = image_name(view, "path", where)
        in_rig = str(view.get("rigId", "-1")) not in {"-1", str((1 << 32) - 1)}  # in newer and older files
        kind = "part of a rig" if in_rig else cameras.get(str(view.get("intrinsicId")), {}).get("type")
        read = partial(_alicevision_pose, pose, f"{path}: pose {view['poseId']} ({file})")
        found.append(FoundCamera(file, f"{where} ({file})", kind, "equirectangular", read))
    whole = FilePoses.of_cameras(found, path)
    (poses,) = whole.groups
    files = [PurePosixPath(name) for name in poses]
    mixed = len({file.is_absolute() for file in files}) > 1
    shared = PurePosixPath("" if mixed else commonpath([str(file.parent) for file in files]))
    # Of a share on a network, the shared folder has one slash in front instead of two, and as many parts.
    below = (str(PurePosixPath(*file.parts[len(shared.parts) :])) for file in files)
    return FilePoses([dict(zip(below, poses.values(), strict=True))], whole.others)


def _entries(data: dict[str, Any], section: str, path: Path) -> list[dict[str, Any]]:
    entries = data.get(section, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: key {section!r} must be a list of objects, as AliceVision writes it")
    return entries


def _alicevision_pose(value: Any, where: str) -> Rigid3:
    transform = value.get("transform") if isinstance(value, dict) else None
    if not isinstance(transform, dict):
        raise InputError(f"{where}: key 'pose' must hold a transform")
    by_columns = number_array(transform, "rotation", (9,), where=where).reshape(3, 3)
    center = number_array(transform, "center", (3,), where=where)
    return Rigid3.from_center(rigid_from_arrays(by_columns.T, center, where).rotation, center)


def opensfm_poses(data: list[dict[str, Any]], path: Path) -> FilePoses:
    """Return the poses of each reconstruction with a spherical camera, by image name.

    The world is east, north, up in metres about `reference_lla`. Without GPS positions, OpenSfM writes a reference at
    latitude and longitude 0, and the unit of length is arbitrary.

    Raises:
        InputError: if a value is invalid, or no camera is spherical; it names the shot and the key.
    """
    if not data:
        raise InputError(
            f"{path}: an empty list of reconstructions: OpenSfM reconstructed nothing. Its log says why; the panoramas "
            "need more overlap, or presets of pano-mvs that find the poses by themselves"
        )
    for item in data:
        if not isinstance(item.get("cameras"), dict) or not isinstance(item["shots"], dict):
            raise InputError(f"{path}: 'cameras' and 'shots' must be objects by name")
    references = [item.get("reference_lla") for item in data]
    found = []
    for number, item in enumerate(data):
        for name, shot in item["shots"].items():
            where = f"{path}: shot {name!r}"
            kind = _opensfm_kind(shot, item["cameras"], where)
            found.append(FoundCamera(name, where, kind, _SPHERICAL, partial(_opensfm_pose, shot, where), number))
    metric = all(isinstance(one, dict) and bool(one.get("latitude") or one.get("longitude")) for one in references)
    return FilePoses.of_cameras(found, path, metric=metric)


def _opensfm_kind(shot: Any, cameras: dict[str, Any], where: str) -> object:
    if not isinstance(shot, dict):
        raise InputError(f"{where}: expected an object, got {type(shot).__name__}")
    camera = cameras.get(str(shot.get("camera", "")))
    kind = camera.get("projection_type") if isinstance(camera, dict) else None
    return _SPHERICAL if kind == "equirectangular" else kind


def _opensfm_pose(shot: dict[str, Any], where: str) -> Rigid3:
    rotvec, translation = (number_array(shot, key, (3,), where=where) for key in ("rotation", "translation"))
    if not np.isfinite(rotvec).all():
        raise InputError(f"{where}: key 'rotation' holds NaN or infinite numbers")
    return rigid_from_arrays(rotation_from_rotvec(rotvec), translation, where)
