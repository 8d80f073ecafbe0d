"""COLMAP sparse models with EQUIRECTANGULAR cameras: written through pycolmap, read by `model_reader`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_from_pixel
from pano_mvs.io.colmap.model_reader import (
    ModelCamera,
    ModelImage,
    ModelPoints3D,
    model_files,
    read_cameras,
    read_images,
    read_points,
)
from pano_mvs.io.colmap.photographs import add_photographs
from pano_mvs.io.colmap.points import ModelForm, ModelPoints, write_model
from pano_mvs.io.colmap.sphere_sfm import has_sphere_cameras, read_sphere_model
from pano_mvs.io.images.captures import natural_key
from pano_mvs.io.poses.json_files import require_distinct
from pano_mvs.scene import Poses
from pano_mvs.scene.photographs import Photographs

_MAX_QUAT_ERROR = 1e-3
_MAX_ERROR_PX = 1e9


def write_colmap_model(
    folder: Path,
    poses: Poses,
    sizes_hw: Mapping[str, tuple[int, int]],
    *,
    photographs: Photographs | None = None,
    form: ModelForm = "bin",
) -> None:
    """Write poses, tracks and points as one COLMAP model: cameras, images, points3D, rigs and frames.

    Each distinct image size has one EQUIRECTANGULAR camera in a trivial rig. The key points of an image are its track
    observations, in pixels of the given size. The same poses give the same bytes.

    Args:
        folder: the folder of the files, which is created if necessary.
        poses: the poses. Errors are converted to pixels at the equator (w / 2π per radian).
        sizes_hw: (height, width) of each image by name.
        photographs: ordinary photographs, in the same world; see `add_photographs`.
        form: "bin" (COLMAP's default), "txt", or "both", of which COLMAP reads the binary files.

    Raises:
        UsageError: if the size of an image is missing.
    """
    import pycolmap

    missing = [name for name in poses.names if name not in sizes_hw]
    if missing:
        raise UsageError(f"the size of {missing[0]} is not given (nor of {len(missing) - 1} more)")
    model = pycolmap.Reconstruction()
    camera_ids = _add_cameras(model, [sizes_hw[name] for name in poses.names])
    points = ModelPoints(poses)
    for idx, name in enumerate(poses.names):
        observed = points.observations(idx)
        pixels = pixel_from_ray(poses.track_bearings[observed], sizes_hw[name])
        image = pycolmap.Image(
            name=name, keypoints=pixels.reshape(-1, 2), camera_id=camera_ids[sizes_hw[name]], image_id=idx + 1
        )
        rotation = pycolmap.Rotation3d(np.asarray(poses.rotations[idx]))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, np.asarray(poses.translations[idx])))
        points.observe(idx + 1, observed, pixels_per_rad=sizes_hw[name][1] / (2 * np.pi))
    if photographs is not None:
        add_photographs(model, photographs, first_camera=len(camera_ids) + 1, first_image=len(poses.names) + 1)
    points.add_to(model)
    write_model(model, folder, form)


def read_colmap_model(folder: Path) -> Poses:
    """Return the registered images, points and tracks of a COLMAP model of panoramas, in its own world and unit.

    Images of other cameras, such as localised photographs, are left out. From SphereSfM's models, whose cameras are
    SPHERE, only the poses are read.

    Args:
        folder: contains cameras, images and points3D as .bin or .txt. Images are sorted in the natural order of names.

    Raises:
        InputError: if the model cannot be read, has no EQUIRECTANGULAR camera, or registers no image.
    """
    if is_colmap_model(folder) and has_sphere_cameras(folder):
        return read_sphere_model(folder)
    files = model_files(folder)
    if files is None:
        raise InputError(
            f"{folder}: no COLMAP model here. Give the folder that holds cameras, images and points3D as "
            ".bin or .txt (often sparse/0)"
        )
    cameras = read_cameras(files[0])
    panoramic = {camera_id for camera_id, camera in cameras.items() if camera.model == "EQUIRECTANGULAR"}
    if cameras and not panoramic:
        camera_id, camera = min(cameras.items())
        raise InputError(
            f"{folder}: camera {camera_id} is {camera.model}, expected EQUIRECTANGULAR. Only models of "
            "panoramas can be used"
        )
    by_id = read_images(files[1])
    ordinary = cameras.keys() - panoramic
    images = sorted(
        (image for image in by_id.values() if image.camera_id not in ordinary),
        key=lambda image: natural_key(image.name),
    )
    if not images:
        raise InputError(f"{folder}: the model registers no image")
    require_distinct([image.name for image in images], folder)
    poses = [_pose(image) for image in images]
    for image in images:
        if image.camera_id not in cameras:
            raise InputError(
                f"{image.where}: its camera {image.camera_id} is not in {files[0].name}. Do the files belong together?"
            )
    points = read_points(files[2])
    tracks = [_observations(image, cameras[image.camera_id], points, path=files[2]) for image in images]
    width_by_id = {i: cameras[image.camera_id].size_hw[1] for i, image in by_id.items() if image.camera_id in cameras}
    return Poses(
        names=tuple(image.name for image in images),
        rotations=np.array([pose.rotation for pose in poses]),
        translations=np.array([pose.translation for pose in poses]),
        points_in_world=points.xyz,
        point_colors_rgb=points.rgb,
        point_errors_rad=_errors_rad(points, width_by_id, files[2]),
        track_point_idx=np.concatenate([indices for indices, _ in tracks]),
        track_image_idx=np.repeat(np.arange(len(images), dtype=np.int32), [len(indices) for indices, _ in tracks]),
        track_bearings=np.concatenate([bearings for _, bearings in tracks]),
        rejected={},
        frame="the world of the COLMAP model",
        scale="the unit of the COLMAP model",
        metric=False,
    )


def is_colmap_model(folder: Path) -> bool:
    """Return whether a folder holds the files of a COLMAP model."""
    return model_files(folder) is not None


def _add_cameras(model: Any, sizes_hw: list[tuple[int, int]]) -> dict[tuple[int, int], int]:
    """Add one camera for each distinct size, and return their ids."""
    import pycolmap

    ids: dict[tuple[int, int], int] = {}
    for height, width in sizes_hw:
        if (height, width) not in ids:
            ids[height, width] = len(ids) + 1
            # An EQUIRECTANGULAR camera without params aborts the process when it is used.
            camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=width, height=height, params=[width, height])
            camera.camera_id = ids[height, width]
            model.add_camera_with_trivial_rig(camera)
    return ids


def _pose(image: ModelImage) -> Rigid3:
    pose = image.cam_from_world()
    if np.abs(image.quat_wxyz).max() > 2 or abs(np.linalg.norm(image.quat_wxyz) - 1) > _MAX_QUAT_ERROR:
        raise InputError(f"{image.where}: the length of its quaternion is not 1. Write the model again")
    return pose


def _observations(
    image: ModelImage, camera: ModelCamera, points: ModelPoints3D, *, path: Path
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the points that an image observes, and the bearings of the observations.

    Raises:
        InputError: if a point does not exist.
    """
    observed = image.point_ids >= 0
    ids = image.point_ids[observed]
    idx = np.searchsorted(points.ids, ids)
    unknown = np.append(points.ids, -1)[idx] != ids
    if unknown.any():
        raise InputError(
            f"{image.where}: observes point {ids[unknown][0]}, which {path.name} does not have. Do the "
            "files belong together?"
        )
    return idx.astype(np.int32), ray_from_pixel(image.pixels[observed], camera.size_hw).reshape(-1, 3)


def _errors_rad(points: ModelPoints3D, width_by_id: Mapping[int, int], path: Path) -> NDArray[np.float32]:
    """Return the errors of points as angles, by the mean width of the images that observe each; 0 if unknown.

    Raises:
        InputError: if an image of a track does not exist.
    """
    observers, which = np.unique(points.track_image_ids, return_inverse=True)
    unknown = next((image_id for image_id in observers.tolist() if image_id not in width_by_id), None)
    if unknown is not None:
        raise InputError(
            f"{path}: a point is observed by image {unknown}, which is not in the model. Do the files belong together?"
        )
    widths = np.array([width_by_id[image_id] for image_id in observers.tolist()], np.float64)[which]
    of_point = np.repeat(np.arange(len(points.ids)), points.track_lengths)
    sums = np.bincount(of_point, widths, minlength=len(points.ids))
    known = (points.errors_px > 0) & np.isfinite(points.errors_px) & (sums > 0)
    rad_per_px = 2 * np.pi * points.track_lengths[known] / sums[known]
    errors = np.zeros(len(points.ids))
    errors[known] = np.minimum(points.errors_px[known], _MAX_ERROR_PX) * rad_per_px
    return errors.astype(np.float32)
