"""COLMAP sparse models with EQUIRECTANGULAR cameras: written and read through pycolmap."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import is_file
from pano_mvs.geometry import pixel_from_ray, ray_from_pixel
from pano_mvs.io.captures import natural_key
from pano_mvs.io.colmap_points import ModelForm, ModelPoints, write_model
from pano_mvs.io.colmap_sphere import has_sphere_cameras, read_sphere_model
from pano_mvs.io.pose_json import require_distinct
from pano_mvs.scene import Poses

_MAX_QUAT_ERROR = 1e-3
_MODEL_FILES = (("cameras.bin", "images.bin", "points3D.bin"), ("cameras.txt", "images.txt", "points3D.txt"))


def write_colmap_model(
    folder: Path, poses: Poses, sizes_hw: Mapping[str, tuple[int, int]], *, form: ModelForm = "bin"
) -> None:
    """Write poses, tracks and points as one COLMAP model: cameras, images, points3D, rigs and frames.

    One EQUIRECTANGULAR camera for each distinct picture size, each its own trivial rig; the key points of an image
    are its track observations, in pixels of the size given. The same poses give the same bytes.

    Args:
        folder: where the files go; made if it is not there.
        poses: what to write. Errors become pixels at the equator (w / 2π per radian).
        sizes_hw: (height, width) of each picture, by the name of the image.
        form: "bin" (COLMAP's usual), "txt", or "both"; COLMAP reads the binary files if it finds both.

    Raises:
        UsageError: if the size of an image is not given.
    """
    import pycolmap

    missing = [name for name in poses.names if name not in sizes_hw]
    if missing:
        raise UsageError(f"the size of {missing[0]} is not given (nor of {len(missing) - 1} more images)")
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
    points.add_to(model)
    write_model(model, folder, form)


def read_colmap_model(folder: Path) -> Poses:
    """Return the registered images, points and tracks of a COLMAP model of panoramas, in its own world and unit.

    Of SphereSfM's models, whose cameras are SPHERE, the poses alone are read.

    Args:
        folder: holds cameras, images and points3D as .bin or .txt; images come in the natural order of their names.

    Raises:
        InputError: if the model cannot be read, has a camera that is no EQUIRECTANGULAR, or registers no image.
    """
    if is_colmap_model(folder) and has_sphere_cameras(folder):
        return read_sphere_model(folder)
    model = _loaded(folder)
    for camera_id, camera in sorted(model.cameras.items()):
        if camera.model_name != "EQUIRECTANGULAR":
            raise InputError(f"{folder}: camera {camera_id} is {camera.model_name}, expected EQUIRECTANGULAR. Only "
                             "models of panoramas can be used")  # fmt: skip
    images = sorted((model.images[idx] for idx in model.reg_image_ids()), key=lambda image: natural_key(image.name))
    if not images:
        raise InputError(f"{folder}: the model registers no image")
    require_distinct([image.name for image in images], folder)
    for image in images:
        if abs(np.linalg.norm(image.cam_from_world().rotation.quat) - 1) > _MAX_QUAT_ERROR:
            raise InputError(f"{folder}: image {image.name}: its quaternion has not length 1. Write the model anew")
    point_ids = sorted(model.points3D)
    point_idx = {point_id: idx for idx, point_id in enumerate(point_ids)}
    points = [model.points3D[point_id] for point_id in point_ids]
    tracks = [_observations(model, image, point_idx) for image in images]
    errors_rad = [point.error * _mean_rad_per_px(model, point) if point.error > 0 else 0.0 for point in points]
    return Poses(
        names=tuple(image.name for image in images),
        rotations=np.array([image.cam_from_world().rotation.matrix() for image in images]),
        translations=np.array([image.cam_from_world().translation for image in images]),
        points_in_world=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        point_colors_rgb=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        point_errors_rad=np.array(errors_rad, np.float32),
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
    return any(all(is_file(folder / name) for name in names) for names in _MODEL_FILES)


def _add_cameras(model: Any, sizes_hw: list[tuple[int, int]]) -> dict[tuple[int, int], int]:
    """Add one camera for each distinct size, and return their ids."""
    import pycolmap

    ids: dict[tuple[int, int], int] = {}
    for height, width in sizes_hw:
        if (height, width) not in ids:
            ids[height, width] = len(ids) + 1
            # Without its params an EQUIRECTANGULAR camera takes the process down when it is used.
            camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=width, height=height, params=[width, height])
            camera.camera_id = ids[height, width]
            model.add_camera_with_trivial_rig(camera)
    return ids


def _loaded(folder: Path) -> Any:
    import pycolmap

    if not is_colmap_model(folder):
        raise InputError(f"{folder}: no COLMAP model here. Give the folder that holds cameras, images and points3D as "
                         ".bin or .txt (often sparse/0)")  # fmt: skip
    try:
        return pycolmap.Reconstruction(str(folder))
    except (RuntimeError, ValueError, IndexError, MemoryError) as error:
        raise InputError(f"{folder}: the COLMAP model cannot be read ({error}). Is it complete?") from error


def _observations(model: Any, image: Any, point_idx: dict[int, int]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the points that an image observes, and the bearings of the observations."""
    camera = model.cameras[image.camera_id]
    observed = [(point_idx[p.point3D_id], p.xy) for p in image.points2D if p.has_point3D()]
    pixels = np.array([xy for _, xy in observed], np.float64).reshape(-1, 2)
    indices = np.array([idx for idx, _ in observed], np.int32)
    return indices, ray_from_pixel(pixels, (camera.height, camera.width))


def _mean_rad_per_px(model: Any, point: Any) -> float:
    widths = [model.cameras[model.images[element.image_id].camera_id].width for element in point.track.elements]
    return 2 * np.pi / float(np.mean(widths)) if widths else 0.0
