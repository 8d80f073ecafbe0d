"""Poses in JSON files: our own poses.json, and nerfstudio's transforms.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, nearest_rotation
from pano_mvs.scene import FilePart


class FoundCamera(NamedTuple):
    """A camera with a pose in a file of another program."""

    name: str  # of the image
    where: str  # file and entry, for messages
    kind: object  # of the camera, in the words of the file
    expected: str  # what the file calls the camera of a panorama
    pose: Callable[[], Rigid3]  # reads cam_from_world; raises InputError
    group: Hashable = None  # cameras of different groups have worlds of their own


@dataclass(frozen=True)
class FilePoses:
    """The poses of the panoramas in a file.

    Attributes:
        groups: cam_from_world by image name; each group has a world of its own, and the largest comes first.
        others: images that have a pose and cannot be used, with the reason.
        metric: whether lengths are metres.
    """

    groups: list[dict[str, Rigid3]]
    others: dict[str, str] = field(default_factory=dict)
    metric: bool = False

    @staticmethod
    def of_cameras(found: Iterable[FoundCamera], path: Path, *, metric: bool = False) -> FilePoses:
        """Return the poses of cameras that are panoramas; the others are named.

        Raises:
            InputError: if there is no panorama, or an image is listed twice in a group.
        """
        groups: dict[Hashable, list[tuple[str, Rigid3]]] = {}
        others: dict[str, str] = {}
        first = ""
        for camera in found:
            if camera.kind == camera.expected:
                groups.setdefault(camera.group, []).append((camera.name, camera.pose()))
            else:
                known = f"is {camera.kind}, expected {camera.expected}"
                others.setdefault(
                    camera.name, f"its camera {known if camera.kind is not None else 'is not in the file'}"
                )
                first = f"{camera.where}: {others[camera.name]}" if len(others) == 1 else first
        if others and not groups:
            raise InputError(f"{first}. Only panoramas can be used")
        ranked = sorted(groups.values(), key=len, reverse=True) or [[]]
        for group in ranked:
            require_distinct([name for name, _ in group], path)
        taken = {name for group in ranked for name, _ in group}
        others = {name: why for name, why in others.items() if name not in taken}
        return FilePoses([dict(group) for group in ranked], others, metric)


@dataclass(frozen=True)
class PosedView:
    """One view of a poses.json."""

    name: str
    cam_from_world: Rigid3
    number: int | None
    sha256: str | None


def read_json_value(path: Path) -> Any:
    """Return the value in a JSON file, of any type.

    Raises:
        InputError: if the file cannot be read or is not JSON.
    """
    try:
        return json.loads(FilePart(path).read_text())
    except InputError:
        raise
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno}:{error.colno}: not JSON ({error.msg})") from error
    except (RecursionError, ValueError) as error:
        raise InputError(f"{path}: nested too deeply, or a number with too many digits") from error


def require_object(value: Any, path: Path) -> dict[str, Any]:
    """Return a JSON value after checking that it is an object, or raise InputError."""
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a JSON object, got {type(value).__name__}")
    return value


def read_posed_views(path: Path) -> tuple[list[PosedView], bool]:
    """Return the views of a poses.json, and whether its lengths are metres.

    The file is {"metric": true, "views": [{"image": "images/000.png", "R": 3 × 3, "t": 3, "id": 0, "sha256": …}, …]}:
    x_in_cam = R x_in_world + t in the camera frame x right, y down, z forward. `id` and `sha256` are optional;
    `metric` is true by default.

    Raises:
        InputError: if a key is missing or malformed; it names the file and the key.
    """
    return posed_views(require_object(read_json_value(path), path), path)


def posed_views(data: dict[str, Any], path: Path) -> tuple[list[PosedView], bool]:
    """Return what `read_posed_views` does, of the object in the file."""
    entries = data.get("views")
    if not isinstance(entries, list):
        raise InputError(f"{path}: key 'views' must be a list of views, got {type(entries).__name__}")
    views = [_posed_view(entry, f"{path}: views[{idx}]") for idx, entry in enumerate(entries)]
    require_distinct([view.name for view in views], path)
    metric = data.get("metric", True)
    if not isinstance(metric, bool):
        raise InputError(f"{path}: key 'metric' must be true or false, without quotes, got {metric!r}")
    return views, metric


def transforms_poses(data: dict[str, Any], path: Path) -> FilePoses:
    """Return the poses in nerfstudio's transforms.json by image name (`panorama`, which we write, or `file_path`).

    Frames whose camera is not EQUIRECTANGULAR are left out, with the reason.

    `transform_matrix` is world_from_cam for OpenGL's camera (x right, y up, z backwards). The world is the file's, or
    that of our run if the file states the rotation `file_from_world` (3 × 3) with which our export turned it.

    Raises:
        InputError: if a key is missing or malformed, or no camera is EQUIRECTANGULAR; it names the file and the key.
    """
    frames = data.get("frames")
    if not isinstance(frames, list):
        raise InputError(f"{path}: key 'frames' must be a list of frames, got {type(frames).__name__}")
    found: list[FoundCamera] = []
    turn = number_array(data, "file_from_world", (3, 3), where=str(path)) if "file_from_world" in data else np.eye(3)
    file_from_world = rigid_from_arrays(turn, np.zeros(3), f"{path}: file_from_world")
    for idx, frame in enumerate(frames):
        where = f"{path}: frames[{idx}]"
        name = image_name(frame, "panorama" if isinstance(frame, dict) and "panorama" in frame else "file_path", where)
        kind = frame.get("camera_model", data.get("camera_model"))
        pose = partial(_opengl_pose, frame, f"{where} ({name})", file_from_world)
        found.append(FoundCamera(name, f"{where} ({name})", kind, "EQUIRECTANGULAR", pose))
    return FilePoses.of_cameras(found, path)


def _opengl_pose(frame: dict[str, Any], where: str, file_from_world: Rigid3) -> Rigid3:
    matrix = number_array(frame, "transform_matrix", (4, 4), where=where)
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: the pose holds NaN or infinite numbers")
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise InputError(f"{where}: the last row of transform_matrix must be 0 0 0 1. Is the matrix transposed?")
    # OpenGL's camera frame is x right, y up, z backwards.
    file_from_cam = rigid_from_arrays(matrix[:3, :3] @ np.diag([1.0, -1.0, -1.0]), matrix[:3, 3], where)
    return file_from_cam.inverse() @ file_from_world


def rigid_from_arrays(rotation: NDArray[np.float64], translation: NDArray[np.float64], where: str) -> Rigid3:
    """Return the transform; small rounding errors of the rotation are corrected.

    Raises:
        InputError: beginning with `where`, if the matrix is not a rotation or a number is not finite.
    """
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise InputError(f"{where}: the pose holds NaN or infinite numbers")
    if np.abs(translation).max() > 1e12:
        raise InputError(f"{where}: a translation of {np.abs(translation).max():.3g} is not a valid position")
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max()) if np.abs(rotation).max() < 2 else np.inf
    if error > 1e-3:
        raise InputError(f"{where}: the rotation is not orthonormal (off by {error:.2g})")
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: the rotation is a reflection (its determinant is −1): the axes are left-handed")
    return Rigid3(rotation if error < 1e-12 else nearest_rotation(rotation), translation)


def require_distinct(names: list[str], path: Path) -> None:
    """Raise InputError if an image is listed twice, or if there is no image."""
    if not names:
        raise InputError(f"{path}: contains no poses")
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{path}: image {name!r} is listed twice")
        seen.add(name)


def _posed_view(entry: Any, where: str) -> PosedView:
    name = image_name(entry, "image", where)
    if "R" not in entry:
        raise InputError(
            f"{where} ({name}): key 'R' is missing, and without a rotation there is no pose. A file of positions alone "
            "has a key 'center' in each view instead of 'R' and 't', and is for pairs.position and poses.scale"
        )
    pose = rigid_from_arrays(
        number_array(entry, "R", (3, 3), where=where), number_array(entry, "t", (3,), where=where), f"{where} ({name})"
    )
    number, digest = entry.get("id"), entry.get("sha256")
    return PosedView(name, pose, number if type(number) is int else None, digest if isinstance(digest, str) else None)


def image_name(entry: Any, key: str, where: str) -> str:
    """Return the name of an image under a key of a JSON object, with forward slashes.

    Raises:
        InputError: beginning with `where`, if there is none.
    """
    if not isinstance(entry, dict):
        raise InputError(f"{where}: expected an object, got {type(entry).__name__}")
    name = entry.get(key)
    if not isinstance(name, str) or not name.strip("/"):
        raise InputError(f"{where}: key {key!r} must be the name of the image, got {name!r}")
    return name.replace("\\", "/").removeprefix("./")


def number_array(entry: dict[str, Any], key: str, shape: tuple[int, ...], *, where: str) -> NDArray[np.float64]:
    """Return the numbers under a key of a JSON object as an array.

    Raises:
        InputError: beginning with `where`, if they have another shape.
    """
    try:
        array = np.array(entry.get(key), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != shape:
        wanted = " × ".join(str(length) for length in shape)
        raise InputError(f"{where}: key {key!r} must hold {wanted} numbers")
    return array
