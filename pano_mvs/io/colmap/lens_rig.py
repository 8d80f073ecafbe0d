"""COLMAP models of the fisheye pictures from which panoramas were stitched: a rig of two OPENCV_FISHEYE cameras."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import FisheyeLens, LensRig, Rigid3, quat_wxyz_from_rotation
from pano_mvs.io.colmap.points import ModelForm, ModelPoints, write_model
from pano_mvs.scene import Poses

# COLMAP's OPENCV_FISHEYE cannot project points at 90° from the axis or beyond.
MAX_ANGLE_DEG = 89.0


@dataclass(frozen=True, slots=True, eq=False)
class LensPictures:
    """The fisheye pictures of one panorama.

    Attributes:
        rig: the lenses.
        image_names: names of the pictures of both lenses, relative to the image folder.
    """

    rig: LensRig
    image_names: tuple[str, str]


def write_lens_rig_model(
    folder: Path, poses: Poses, pictures: Mapping[str, LensPictures], *, form: ModelForm = "bin"
) -> Mapping[str, int]:
    """Write a COLMAP model of fisheye pictures: rigs, OPENCV_FISHEYE cameras, frames, points and tracks.

    The first lens defines the frame of the rig; `sensor_from_rig` of the second contains the distance of the lenses. An
    observation in a panorama becomes one of the lens that the panorama shows there. Observations more than 89° from the
    axis of their lens are omitted, because COLMAP's model cannot project beyond 90°, and so are points without others.

    Args:
        folder: the folder of the files, which is created if necessary.
        poses: poses of the panoramas, in metres, with points and tracks.
        pictures: panorama name to its pictures; panoramas without an entry are omitted.
        form: "bin", "txt" or "both".

    Returns:
        Image name to the number of points that it observes.

    Raises:
        UsageError: if the poses are not in metres, because the distance of the lenses is.
    """
    import pycolmap

    if not poses.metric:
        raise UsageError("poses must be in metres, because the distance of the lenses is: add poses.scale")
    model = pycolmap.Reconstruction()
    rig_ids = _add_rigs(model, [pictures[name].rig for name in poses.names if name in pictures])
    points = ModelPoints(poses)
    seen: dict[str, int] = {}
    for idx, name in enumerate(poses.names):
        if name not in pictures:
            continue
        own = pictures[name]
        rig_id = rig_ids[_calibration(own.rig)]
        frame_id = len(seen) // 2 + 1
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=rig_id)
        image_ids, camera_ids = (len(seen) + 1, len(seen) + 2), (2 * rig_id - 1, 2 * rig_id)
        for image_id, camera_id in zip(image_ids, camera_ids, strict=True):
            frame.add_data_id(pycolmap.data_t(_sensor(camera_id), image_id))
        frame.rig_from_world = _rigid(own.rig.lens_from_rig[0] @ poses.cam_from_world(idx))
        model.add_frame(frame)
        of_panorama = points.observations(idx)
        bearings = poses.track_bearings[of_panorama]
        labels = own.rig.lens_of_bearings(bearings)
        for lens_idx, (image_id, camera_id) in enumerate(zip(image_ids, camera_ids, strict=True)):
            kept, pixels = _pixels(own.rig, lens_idx, bearings, labels=labels)
            image_name = own.image_names[lens_idx]
            image = pycolmap.Image(name=image_name, keypoints=pixels, camera_id=camera_id, image_id=image_id)
            image.frame_id = frame_id
            model.add_image(image)
            pixels_per_rad = float(np.mean(own.rig.lenses[lens_idx].focal_xy))
            points.observe(image_id, of_panorama[kept], pixels_per_rad=pixels_per_rad)
            seen[image_name] = len(pixels)
        model.register_frame(frame_id)
    points.add_to(model, only_seen=True)
    write_model(model, folder, form)
    return seen


def rig_configuration(rig: LensRig) -> str:
    """Return the JSON with which `colmap rig_configurator` applies the calibration to a database."""
    turn = second_from_first(rig)
    first, second = (
        {
            "image_prefix": f"{name}/",
            "camera_model_name": "OPENCV_FISHEYE",
            "camera_params": _params(lens),
        }
        for name, lens in zip(rig.names, rig.lenses, strict=True)
    )
    pose = {
        "cam_from_rig_rotation": quat_wxyz_from_rotation(turn.rotation).tolist(),
        "cam_from_rig_translation": turn.translation.tolist(),
    }
    return json.dumps([{"cameras": [first | {"ref_sensor": True}, second | pose]}], indent=1) + "\n"


def second_from_first(rig: LensRig) -> Rigid3:
    """Return the transform from the frame of the first lens to that of the second, in metres."""
    return rig.lens_from_rig[1] @ rig.lens_from_rig[0].inverse()


def _add_rigs(model: Any, rigs: list[LensRig]) -> dict[str, int]:
    """Add a rig for each calibration, and return their ids; the cameras of a rig are 2 id − 1 and 2 id."""
    import pycolmap

    ids: dict[str, int] = {}
    for rig in rigs:
        key = _calibration(rig)
        if key in ids:
            continue
        rig_id = ids[key] = len(ids) + 1
        camera_ids = 2 * rig_id - 1, 2 * rig_id
        for camera_id, lens in zip(camera_ids, rig.lenses, strict=True):
            height, width = lens.size_hw
            model.add_camera(
                pycolmap.Camera(
                    camera_id=camera_id, model="OPENCV_FISHEYE", width=width, height=height, params=_params(lens)
                )
            )
        added = pycolmap.Rig(rig_id=rig_id)
        added.add_ref_sensor(_sensor(camera_ids[0]))
        added.add_sensor(_sensor(camera_ids[1]), _rigid(second_from_first(rig)))
        model.add_rig(added)
    return ids


def _calibration(rig: LensRig) -> str:
    return json.dumps(rig.to_values()["lenses"])


def _params(lens: FisheyeLens) -> list[float]:
    return [*lens.focal_xy, *lens.principal_xy, *lens.distortion]


def _sensor(camera_id: int) -> Any:
    import pycolmap

    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def _rigid(pose: Rigid3) -> Any:
    import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(pose.rotation)), pose.translation)


def _pixels(
    rig: LensRig, lens_idx: int, bearings: FloatArray, *, labels: NDArray[np.int8]
) -> tuple[NDArray[np.intp], FloatArray]:
    """Return which bearings a lens observes, and their pixels in its picture, (n, 2)."""
    lens = rig.lenses[lens_idx]
    rays = rig.points_in_lens(bearings, lens_idx)
    kept = np.flatnonzero((labels == lens_idx) & (lens.angle_from_axis(rays) < np.radians(MAX_ANGLE_DEG)))
    return kept, lens.pixel_from_ray(rays[kept]).reshape(-1, 2)
