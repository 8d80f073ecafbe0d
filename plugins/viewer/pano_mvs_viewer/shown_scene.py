"""Load the scene of an output folder or of a single PLY file for the viewer."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.file_names import file_inside
from pano_mvs.core.paths import is_file, is_folder, resolved
from pano_mvs.core.text import plural, shortened_list
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ply import PlyPoints, open_ply_points
from pano_mvs.io.poses.files import read_poses
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene.files import group_file
from pano_mvs.scene.upright import WORLD_UP, mean_up_direction

_CLOUD, _MESH, _MODELS = "cloud.ply", "mesh.ply", "colmap/sparse"


@dataclass(frozen=True, eq=False)
class ShownCamera:
    """A camera to step into."""

    name: str
    cam_from_world: Rigid3
    picture: Path | None  # its panorama, or None if the file is missing
    preview: Path | None  # a small image whose upper half is the panorama, or None
    range_file: Path | None = None  # its ranges as float32 TIFF, or None
    confidence_file: Path | None = None  # its confidences as PNG, or None
    doubtful: bool = False  # whether the run found its pose doubtful

    @property
    def label(self) -> str:
        """Label of the camera."""
        return f"{self.name} (doubtful)" if self.doubtful else self.name


@dataclass(frozen=True, eq=False)
class ShownScene:
    """The scene to show."""

    name: str  # of the folder or file
    cloud: PlyPoints | None  # the vertices of the cloud, or None
    mesh: Path | None  # a PLY file with faces, or None
    cameras: tuple[ShownCamera, ...]  # in the order of the capture
    unit: str  # of lengths: "m" or "scene units"
    up: FloatArray  # (3,) unit vector, up in the world
    ahead: FloatArray  # (3,) unit vector orthogonal to `up`: the viewing direction of the first camera
    notes: tuple[str, ...] = ()  # what is missing, and why

    @property
    def centers(self) -> FloatArray:
        """Centres of the cameras, (N, 3)."""
        return np.array([camera.cam_from_world.center for camera in self.cameras]).reshape(-1, 3)


def open_scene(path: Path, *, images: Path | None = None, group: int = 0) -> ShownScene:
    """Return the scene of an output folder or of a PLY file.

    Args:
        path: the output folder of a run, or a PLY file, a cloud or a mesh.
        images: folder of the panoramas; None: where the run read them, else the previews that it wrote.
        group: group of poses to show, since each has its own frame; 0 is the largest.

    Raises:
        InputError: if there is nothing to show, or a file is damaged.
        UsageError: if there is no such group.
    """
    if is_file(path):
        points, mesh = (None, path) if has_faces(path) else (open_ply_points(path), None)
        if points is not None and not points.count:
            raise InputError(
                f"{path}: contains no points, so there is nothing to show. Check the program that wrote it"
            )
        return ShownScene(path.name, points, mesh, (), "scene units", *_frame(()))
    if not is_folder(path):
        raise InputError(f"{path}: no such file or folder. Give the output folder of a run, or a .ply file")
    run = _summary(path)
    notes: list[str] = []
    groups = run.poses.by_group()
    if group >= len(groups):
        raise UsageError(f"--group {group}: {path} has {len(groups)} {plural(len(groups), 'group')}, numbered from 0")
    if len(groups) > 1:
        sizes = [f"{number} ({len(poses.registered)} images)" for number, poses in enumerate(groups)]
        notes.append(
            f"this is group {group} of {len(groups)}, each with its own frame and scale; --group N "
            f"shows another: {', '.join(sizes[:group] + sizes[group + 1 :])}"
        )
    chosen = groups[group]
    cloud_name, mesh_name, model = group_file(_CLOUD, group), group_file(_MESH, group), f"{_MODELS}/{group}"
    mesh_file = _written(path, run, mesh_name)
    cameras = _cameras(path, model, run, images=images, notes=notes)
    if doubtful := [camera.name for camera in cameras if camera.doubtful]:
        shown = shortened_list(doubtful, 5, rest=" …")
        notes.append(f"doubtful: {shown}; the ranges of these cameras may be in the wrong place, see report.html")
    cloud = _cloud(_written(path, run, cloud_name), cloud_name, notes)
    if cloud is None and mesh_file is None and not cameras:
        raise InputError(
            f"{path}: contains no {cloud_name} with points, no {mesh_name} and no {model}. Give the output "
            "folder of a run; its report.html shows what happened"
        )
    up, ahead = _frame(cameras, is_level=chosen.axes.is_level)
    return ShownScene(
        name=resolved(path).name,
        cloud=cloud,
        mesh=mesh_file,
        cameras=cameras,
        unit="m" if chosen.metric else "scene units",
        up=up,
        ahead=ahead,
        notes=tuple(notes),
    )


def _cloud(path: Path | None, name: str, notes: list[str]) -> PlyPoints | None:
    """Return the vertices of a cloud; None, with a note, if the file is missing or contains no points."""
    cloud = None if path is None else open_ply_points(path)
    if cloud is not None and cloud.count:
        return cloud
    if cloud is None:
        notes.append(f"no {name}: the workflow has no export.ply, or the run did not reach it")
    else:
        notes.append(f"{name} contains no points: report.html shows why")
    return None


def has_faces(path: Path) -> bool:
    """Return whether a PLY file contains faces."""
    try:
        with path.open("rb") as stream:
            head = stream.read(1 << 14)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Check that it exists and may be read") from error
    counted = re.search(rb"^element face ([0-9]{1,18})\s*$", head.partition(b"end_header")[0], re.MULTILINE)
    return counted is not None and int(counted[1]) > 0


def _summary(folder: Path) -> RunSummary:
    """Return the summary in run.json, or an empty one if it cannot be read, since the files suffice."""
    try:
        return RunSummary.read(folder)
    except InputError:
        return RunSummary()


def _written(folder: Path, run: RunSummary, name: str) -> Path | None:
    """Return the file with this name in the folder, or the first one that the run wrote below it."""
    names = [name, *(written for written in run.files if PurePosixPath(written).name == name)]
    return next((folder / found for found in names if is_file(folder / found)), None)


def _cameras(
    folder: Path, model_name: str, run: RunSummary, *, images: Path | None, notes: list[str]
) -> tuple[ShownCamera, ...]:
    model = folder / model_name
    if not is_folder(model):
        notes.append(f"no {model_name}: the workflow has no export.colmap, or the run did not reach it; no cameras")
        return ()
    poses = read_poses(model)
    source = images or run.source_folder
    previews = {view.name: view.preview for view in run.views}
    cameras = []
    for idx, name in enumerate(poses.names):
        cameras.append(
            ShownCamera(
                name=name,
                cam_from_world=poses.cam_from_world(idx),
                picture=run.source_file(name, images),
                preview=file_inside(folder, previews.get(name) or f"preview/{PurePosixPath(name).with_suffix('.jpg')}"),
                range_file=_map_of(folder, "range", name, suffix=".tiff"),
                confidence_file=_map_of(folder, "confidence", name, suffix=".png"),
                doubtful=name in run.poses.doubts,
            )
        )
    if any(camera.picture is None for camera in cameras):
        where = source if source is not None else "the place from which the run read them"
        notes.append(f"panoramas are not in {where}: shown by their previews; give --images DIR for the pictures")
    return tuple(cameras)


def _map_of(folder: Path, kind: str, name: str, *, suffix: str) -> Path | None:
    """Return the file of an image in range/ or confidence/, named with or without the image's extension."""
    candidates = (f"{kind}/{name}{suffix}", f"{kind}/{PurePosixPath(name).with_suffix(suffix)}")
    return next((path for candidate in candidates if (path := file_inside(folder, candidate))), None)


def _frame(cameras: tuple[ShownCamera, ...], *, is_level: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return the directions up and ahead: −y in a level world or if the cameras disagree, else that of the cameras."""
    common_up = None if is_level else mean_up_direction([camera.cam_from_world.rotation for camera in cameras])
    up = np.array(WORLD_UP) if common_up is None else common_up
    ahead = cameras[0].cam_from_world.rotation[2] if cameras else np.array([0.0, 0.0, 1.0])
    ahead = ahead - up * float(ahead @ up)
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    return up, ahead / np.linalg.norm(ahead)
