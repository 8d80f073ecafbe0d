"""Write key points and verified matches to a COLMAP database, as panoramas or as rigs of pinhole faces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import CUBE_NAMES, CUBE_ROTATIONS
from pano_mvs.core.arrays import FloatArray, IndexArray
from pano_mvs.geometry import Rigid3, pixel_from_ray, skew
from pano_mvs.scene import Features, TwoView

Cameras = Literal["sphere", "faces"]
TwoViews = Mapping[tuple[str, str], TwoView]


@dataclass(frozen=True, eq=False)
class DatabaseImage:
    """One COLMAP image: a panorama, or one of its faces."""

    panorama_idx: int  # position of the panorama among the features
    # (N,) the panorama's key points in this image; keypoint_idx[n] is key point n of the image
    keypoint_idx: IndexArray
    face_from_panorama: FloatArray  # (3, 3) rotation; the identity for a whole panorama


def write_database(
    path: Path, features: Mapping[str, Features], two_views: TwoViews, *, cameras: Cameras
) -> dict[int, DatabaseImage]:
    """Write a database for COLMAP's mappers, in a fixed order: the same input gives the same rows.

    Args:
        path: file to create; it must not exist.
        features: key points by image name, in the capture's order.
        two_views: verified pairs; those without a general geometry are left out.
        cameras: "sphere": one EQUIRECTANGULAR image per panorama; "faces": six pinhole faces of one rig, with every key
            point in the face that contains it.

    Returns:
        COLMAP's image id to the content of the image.
    """
    import pycolmap

    database = pycolmap.Database.open(path)
    try:
        with pycolmap.DatabaseTransaction(database):
            write = _write_sphere if cameras == "sphere" else _write_faces
            sensors: dict[tuple[int, int], tuple[int, list[int]]] = {}
            images: dict[int, DatabaseImage] = {}
            for idx, (name, found) in enumerate(features.items()):
                images |= write(database, sensors, idx=idx, name=name, found=found)
            _write_pairs(database, tuple(features), two_views, images=images)
    finally:
        database.close()
    return images


def _write_sphere(database: Any, sensors: dict[Any, Any], *, idx: int, name: str, found: Features) -> dict[int, Any]:
    import pycolmap

    height, width = found.size_hw
    if found.size_hw not in sensors:
        # An EQUIRECTANGULAR camera without params crashes the process when it is used.
        camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=width, height=height, params=[width, height])
        sensors[found.size_hw] = _write_rig(database, [camera], np.eye(3)[None])
    rig_id, camera_ids = sensors[found.size_hw]
    (image_id,) = _write_frame(database, rig_id, camera_ids, names=[name])
    database.write_keypoints(image_id, pixel_from_ray(found.bearings, found.size_hw).astype(np.float32))
    return {image_id: DatabaseImage(idx, np.arange(len(found), dtype=np.int32), np.eye(3))}


def _write_faces(database: Any, sensors: dict[Any, Any], *, idx: int, name: str, found: Features) -> dict[int, Any]:
    import pycolmap

    size = face_size(found.size_hw)
    if found.size_hw not in sensors:
        half = size / 2  # the focal length of a face of 90° is half its width
        faces = [
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=size, height=size, params=[half, half, half])
            for _ in CUBE_ROTATIONS
        ]
        for camera in faces:
            camera.has_prior_focal_length = True
        sensors[found.size_hw] = _write_rig(database, faces, CUBE_ROTATIONS)
    rig_id, camera_ids = sensors[found.size_hw]
    image_ids = _write_frame(database, rig_id, camera_ids, names=[f"{face}/{name}" for face in CUBE_NAMES])
    face_of_keypoint = face_of_bearing(found.bearings)
    written = {}
    for face_idx, image_id in enumerate(image_ids):
        inside = np.flatnonzero(face_of_keypoint == face_idx).astype(np.int32)
        database.write_keypoints(
            image_id, face_pixels(found.bearings[inside], face_idx, size).astype(np.float32).reshape(-1, 2)
        )
        written[image_id] = DatabaseImage(idx, inside, CUBE_ROTATIONS[face_idx])
    return written


def _write_rig(database: Any, cameras: list[Any], face_from_panorama: FloatArray) -> tuple[int, list[int]]:
    """Write the cameras of one rig, whose frame is the panorama's; return the ids of the rig and of the cameras."""
    import pycolmap

    camera_ids = [database.write_camera(camera) for camera in cameras]
    rig = pycolmap.Rig()
    rig.add_ref_sensor(_camera_sensor(camera_ids[0]))
    for camera_id, rotation in zip(camera_ids[1:], face_from_panorama[1:], strict=True):
        rig.add_sensor(_camera_sensor(camera_id), pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.zeros(3)))
    return database.write_rig(rig), camera_ids


def _write_frame(database: Any, rig_id: int, camera_ids: list[int], *, names: list[str]) -> list[int]:
    """Write the images of one panorama, and the frame that joins them; return the image ids."""
    import pycolmap

    frame = pycolmap.Frame()
    frame.rig_id = rig_id
    image_ids = []
    for camera_id, name in zip(camera_ids, names, strict=True):
        image_id = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        frame.add_data_id(pycolmap.data_t(_camera_sensor(camera_id), image_id))
        image_ids.append(image_id)
    database.write_frame(frame)
    return image_ids


def _camera_sensor(camera_id: int) -> Any:
    import pycolmap

    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def _write_pairs(
    database: Any, names: tuple[str, ...], two_views: TwoViews, *, images: Mapping[int, DatabaseImage]
) -> None:
    """Write matches and geometry of every pair of images with common matches."""
    position = {name: idx for idx, name in enumerate(names)}
    place = _places(images, len(names))
    for (first, second), view in sorted(two_views.items(), key=lambda item: tuple(position[n] for n in item[0])):
        if not view:
            continue
        ids_a, numbers_a = (row[view.matches_idx[:, 0]] for row in place[position[first]])
        ids_b, numbers_b = (row[view.matches_idx[:, 1]] for row in place[position[second]])
        numbers = np.stack([numbers_a, numbers_b], axis=1).astype(np.uint32)
        for image_a, image_b in sorted(set(zip(ids_a.tolist(), ids_b.tolist(), strict=True))):
            shared = (ids_a == image_a) & (ids_b == image_b)
            turn_a, turn_b = images[image_a].face_from_panorama, images[image_b].face_from_panorama
            b_from_a = Rigid3(turn_b @ view.rotation @ turn_a.T, turn_b @ view.direction)
            database.write_matches(image_a, image_b, numbers[shared])
            database.write_two_view_geometry(image_a, image_b, _geometry(b_from_a, numbers[shared]))


def _geometry(second_from_first: Rigid3, matches: NDArray[np.uint32]) -> Any:
    import pycolmap

    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.E = skew(second_from_first.translation) @ second_from_first.rotation
    geometry.cam2_from_cam1 = pycolmap.Rigid3d(
        pycolmap.Rotation3d(second_from_first.rotation), second_from_first.translation
    )
    geometry.inlier_matches = matches
    return geometry


def _places(images: Mapping[int, DatabaseImage], count: int) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return for each panorama, by key point, the id of the image that contains it and its number in that image."""
    sizes = np.zeros(count, np.int64)
    for image in images.values():
        sizes[image.panorama_idx] += len(image.keypoint_idx)
    places = [(np.zeros(size, np.int64), np.zeros(size, np.int64)) for size in sizes]
    for image_id, image in images.items():
        ids, numbers = places[image.panorama_idx]
        ids[image.keypoint_idx] = image_id
        numbers[image.keypoint_idx] = np.arange(len(image.keypoint_idx))
    return places


def face_size(size_hw: tuple[int, int]) -> int:
    """Return the face width in pixels with the resolution of the equator at the face's centre: w / π, rounded up."""
    return int(np.ceil(size_hw[1] / np.pi))


def face_of_bearing(bearings: FloatArray) -> NDArray[np.int32]:
    """Return the face of each ray of the panorama, (N, 3) to (N,); on an edge, the first of the two faces."""
    faces: NDArray[np.int32] = (bearings @ CUBE_ROTATIONS[:, 2].T).argmax(axis=1).astype(np.int32)
    return faces


def face_pixels(bearings: FloatArray, face_idx: int, size: int) -> FloatArray:
    """Return the pixels, (N, 2), of rays of the panorama, (N, 3), in a face of 90° and size × size pixels."""
    in_face = bearings @ CUBE_ROTATIONS[face_idx].T
    pixels: FloatArray = (in_face[:, :2] / in_face[:, 2:] + 1) * (size / 2)
    return pixels
