"""Read poses from any supported file or folder."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import unwrap
from pathlib import Path

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import exists, is_file, is_folder
from pano_mvs.core.text import plural, shortened, shortened_list
from pano_mvs.geometry import Rigid3, rotation_from_quat_wxyz
from pano_mvs.io.colmap.reader import is_colmap_model, read_colmap_model
from pano_mvs.io.images.names import match_image_names, without_shared
from pano_mvs.io.poses.json_files import (
    FilePoses,
    posed_views,
    read_json_value,
    require_distinct,
    require_object,
    rigid_from_arrays,
    transforms_poses,
)
from pano_mvs.io.poses.metashape import read_metashape
from pano_mvs.io.poses.other_json import alicevision_poses, openmvg_poses, opensfm_poses
from pano_mvs.io.poses.positions import NO_POSES, csv_cells, holds_positions, latitude_heading, read_positions
from pano_mvs.io.poses.trajectories import SUFFIXES, match_times, read_trajectory
from pano_mvs.io.readers import pose_reader_of, poses_of_plugin
from pano_mvs.scene import FilePart, Poses
from pano_mvs.scene.pose_groups import with_cameras

CSV_HEADER = ("name", "tx", "ty", "tz", "qw", "qx", "qy", "qz")
_CSV_HEADINGS = (
    f"the first line must be {','.join(CSV_HEADER)} for poses, or, where positions alone are needed, name columns "
    "name, x, y, z or label, easting, northing, height, in metres"
)
_JSON = (".json", ".sfm")
# The keys by which the JSON object of another program is known.
_BY_KEYS = (
    ({"views", "intrinsics", "extrinsics"}, openmvg_poses),
    ({"version", "views", "intrinsics"}, alicevision_poses),
    ({"frames"}, transforms_poses),
)
_IN_A_FOLDER = (
    "transforms.json",
    "poses.json",
    "truth/poses.json",
    "poses.csv",
    "reconstruction.json",
    "sfm_data.json",
    "cameras.sfm",
)


def read_poses(path: Path) -> Poses:
    """Return the poses in a file or folder, with image names as stored (see `match_image_names`).

    Supported are
      * a folder with a COLMAP model of EQUIRECTANGULAR cameras (.bin or .txt), itself or in sparse/0, or with a model
        of SphereSfM with SPHERE cameras, whose points are ignored;
      * nerfstudio's transforms.json (camera_model EQUIRECTANGULAR);
      * OpenSfM's reconstruction.json with a spherical camera; the largest of several reconstructions;
      * openMVG's sfm_data.json with spherical cameras;
      * AliceVision's (Meshroom's) .sfm or .json with equirectangular cameras;
      * Metashape's XML of cameras with a spherical sensor; the largest of several components;
      * our own poses.json: {"metric": true, "views": [{"image": …, "R": 3 × 3, "t": 3}]}, cam_from_world;
      * a CSV file whose first line is name,tx,ty,tz,qw,qx,qy,qz: cam_from_world as x_in_cam = R(q) x_in_world + t in
        the camera frame x right, y down, z forward; quaternions of any length; empty lines and lines that begin
        with # are ignored;
      * a trajectory of the TUM benchmark, .txt or .tum, whose images are called by their times (see `match_images`);
      * what a plugin reads (`pano_mvs.io.readers`).

    Cameras of other kinds than panoramas are in `rejected`, with the reason.

    Raises:
        InputError: if the file is invalid; it names the file, and the line or the key.
    """
    return _groups_in(_file_or_model(path))[0]


def _groups_in(path: Path) -> list[Poses]:
    """Return the poses in a file or a COLMAP model, those of the largest group first."""
    if is_folder(path):
        return [read_colmap_model(path)]
    found = _read_file(path)
    scale = "metres, as the file has it" if found.metric else "the unit of the file"
    groups = []
    for number, poses in enumerate(found.groups, start=1):
        frame = f"the world of {path.name}" + (f", group {number}" if len(found.groups) > 1 else "")
        others = found.others if number == 1 else {}
        groups.append(Poses.without_points(poses, rejected=others, frame=frame, scale=scale, metric=found.metric))
    return groups


def _read_file(path: Path) -> FilePoses:
    if (found := poses_of_plugin(path)) is not None:
        return FilePoses([dict(group) for group in found.groups], dict(found.others), metric=found.metric)
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return FilePoses([read_csv(path)])
    if suffix == ".xml":
        return read_metashape(path)
    if suffix not in (*_JSON, *SUFFIXES):
        raise InputError(
            f"{path}: poses are read from a COLMAP model (its folder), .json, .sfm, .xml, .csv, and .txt or .tum "
            f"(trajectories), not {suffix!r}"
        )
    if suffix in SUFFIXES:
        return FilePoses([read_trajectory(path)])
    if suffix == ".json" and holds_positions(path):
        raise InputError(f"{path}: {NO_POSES}")
    value = read_json_value(path)
    if isinstance(value, list) and all(isinstance(item, dict) and "shots" in item for item in value):
        return opensfm_poses(value, path)
    data = require_object(value, path)
    for keys, read in _BY_KEYS:
        if keys <= data.keys():
            return read(data, path)
    if "views" in data:
        views, metric = posed_views(data, path)
        return FilePoses([{view.name: view.cam_from_world for view in views}], metric=metric)
    raise InputError(
        f"{path}: neither key 'frames' (nerfstudio) nor key 'views' (pano-mvs), nor a list with 'shots' "
        "(OpenSfM): no poses here"
    )


def read_groups(path: Path) -> list[Poses]:
    """Return the poses in a file or folder, and those of further groups.

    Further groups are the models sparse/1, sparse/2 … next to sparse/0 if a folder above them is given, further
    reconstructions of OpenSfM and components of Metashape. Each has its own world. Images of an earlier group are
    omitted.
    """
    model = _file_or_model(path)
    found = _groups_in(model)
    number = 1
    while model != path and model.name == "0" and is_colmap_model(model.with_name(str(number))):
        found += _groups_in(model.with_name(str(number)))
        number += 1
    groups: list[Poses] = []
    for group in found:
        known = {name for earlier in groups for name in earlier.names}
        groups.append(with_cameras(group, np.array([name not in known for name in group.names], np.bool_)))
    return groups


def positions_in(path: Path) -> dict[str, FloatArray]:
    """Return the position (3,) of each image in a file of positions (`read_positions`), or of poses.

    Raises:
        InputError: if the file is invalid.
    """
    if is_file(path) and holds_positions(path):
        return read_positions(path)
    poses = read_poses(path)
    return dict(zip(poses.names, poses.centers, strict=True))


def matched_positions(images: Sequence[str], path: Path) -> tuple[dict[str, FloatArray], list[str]]:
    """Return the position (3,) of each image of a capture that one has in a file, and notes on how they were matched.

    Images that match one position together have none.

    Raises:
        InputError: if the file is invalid, or a trajectory cannot be matched.
    """
    place = positions_in(path)
    matched, how = match_images(images, tuple(place), path)
    clear = without_shared(matched)
    notes = [how] if how else []
    if shared := [name for name in matched if name not in clear]:
        notes.append(
            f"{path.name} has one position for several images, which was not used for any of them: "
            f"{shortened_list(shared, 5)}"
        )
    return {name: place[there] for name, there in clear.items()}, notes


def match_images(images: Sequence[str], names: Sequence[str], path: Path) -> tuple[dict[str, str], str]:
    """Return the name in a file of poses of each image of a capture, and a note on how they were matched, or "".

    Names are compared by `match_image_names`; those of a trajectory are times, see `match_times`.
    """
    if path.suffix.lower() not in SUFFIXES or is_folder(path) or pose_reader_of(path) is not None:
        return match_image_names(images, names), ""
    matched, how = match_times(images, names, path)
    return matched, f"the poses in {path.name} belong to the images by {how}"


def file_of_reader(path: Path) -> Path | None:
    """Return the Python file of the plugin that reads a file of poses or positions; None if no plugin reads it."""
    try:
        path = _file_or_model(path)
    except InputError:
        return None
    reader = None if is_folder(path) else pose_reader_of(path)
    code = None if reader is None else getattr(unwrap(reader.read), "__code__", None)
    return None if code is None else Path(code.co_filename)


def recorded_pictures(path: Path) -> dict[str, str]:
    """Return the SHA-256 of the images of poses by name, if the file states them (poses.json)."""
    path = _file_or_model(path)
    is_ours = path.suffix.lower() in _JSON and pose_reader_of(path) is None
    value = read_json_value(path) if is_ours else None
    if not isinstance(value, dict) or "views" not in value or any(keys <= value.keys() for keys, _ in _BY_KEYS):
        return {}
    return {view.name: view.sha256 for view in posed_views(value, path)[0] if view.sha256 is not None}


def read_csv(path: Path) -> dict[str, Rigid3]:
    """Return the cam_from_world of each image in a CSV file; see `read_poses` for its columns.

    Raises:
        InputError: if the file is invalid; it names the line.
    """
    lines = FilePart(path).read_text().splitlines()
    if holds_positions(path):
        raise InputError(f"{path}: {NO_POSES}")
    rows = [
        (number, csv_cells(line, ",", f"{path}:{number}"))
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.startswith("#")
    ]
    if rows and tuple(rows[0][1]) == CSV_HEADER:
        poses = [(row[0], _pose_from_row(row, f"{path}:{line}")) for line, row in rows[1:]]
        require_distinct([name for name, _ in poses], path)
        return dict(poses)
    if heading := latitude_heading(path):
        raise InputError(
            f"{path}:{heading.number}: latitudes and longitudes are not read from a table; {_CSV_HEADINGS}. Convert "
            "them to metres, such as UTM, or write them into the EXIF metadata of the images"
        )
    raise InputError(f"{path}:{rows[0][0] if rows else 1}: {_CSV_HEADINGS}")


def _file_or_model(path: Path) -> Path:
    """Return the file with poses or the folder of a COLMAP model, given it or a folder above it."""
    if not exists(path):
        raise InputError(
            f"{path}: no such file or folder. Give a COLMAP model, a transforms.json, a "
            "poses.json, a reconstruction.json, a sfm_data.json, a cameras.sfm, an XML file of Metashape, a CSV file "
            "or a trajectory (.txt, .tum)"
        )
    if not is_folder(path):
        return path
    for model in (path, path / "sparse" / "0", path / "colmap" / "sparse" / "0"):
        if is_colmap_model(model):
            return model
    for name in _IN_A_FOLDER:
        if is_file(path / name):
            return path / name
    raise InputError(
        f"{path}: no poses here. A folder must hold a COLMAP model (cameras, images, points3D), or one "
        f"of {', '.join(_IN_A_FOLDER)}"
    )


def _pose_from_row(row: list[str], where: str) -> Rigid3:
    if len(row) != len(CSV_HEADER) or not row[0]:
        raise InputError(
            f"{where}: expected a name and 7 numbers ({','.join(CSV_HEADER)}), got "
            f"{len(row)} {plural(len(row), 'cell')}"
        )
    try:
        numbers = np.array([float(cell) for cell in row[1:]])
    except ValueError as error:
        raise InputError(f"{where}: {shortened(str(error), 200)}") from error
    quat_wxyz = numbers[3:]
    if not np.isfinite(numbers).all() or not 1e-6 < np.abs(quat_wxyz).max() < 1e100:
        raise InputError(f"{where}: the pose of {row[0]} has no finite numbers, or a quaternion of length 0")
    return rigid_from_arrays(rotation_from_quat_wxyz(quat_wxyz), numbers[:3], where)
