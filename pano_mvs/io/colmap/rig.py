"""COLMAP models of panoramas that were cut into faces: one rig of pinhole cameras for each layout of faces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import PinholeView, Rigid3
from pano_mvs.io.colmap.photographs import add_photographs
from pano_mvs.io.colmap.points import ModelForm, ModelPoints, write_model
from pano_mvs.scene import Poses
from pano_mvs.scene.photographs import Photographs


@dataclass(frozen=True, slots=True, eq=False)
class CutPanorama:
    """The faces of one panorama.

    Attributes:
        views: the faces. Panoramas that share the same sequence object share a rig.
        image_names: names of the faces' images in the same order, relative to the image folder.
    """

    views: Sequence[PinholeView]
    image_names: Sequence[str]


def write_rig_model(
    folder: Path,
    poses: Poses,
    cuts: Mapping[str, CutPanorama],
    *,
    photographs: Photographs | None = None,
    form: ModelForm = "both",
) -> Mapping[str, int]:
    """Write a COLMAP model of the faces of panoramas: rigs, a PINHOLE camera per face, frames, points, tracks.

    The first face defines the rig's coordinate frame; `cam_from_rig` of the others are pure rotations. Each panorama is
    a frame whose images are its faces. An observation belongs to the face whose axis is nearest, if it is inside that
    face. Points that no face observes are omitted, because OpenMVS stops reading at the first of them.

    Args:
        folder: the folder of the files, which is created if necessary.
        poses: poses of the panoramas with points and tracks. Errors become pixels at a face's centre (f per radian).
        cuts: panorama name to its faces; panoramas without an entry are omitted.
        photographs: ordinary photographs, in the same world; see `add_photographs`.
        form: "bin", "txt" or "both". COLMAP prefers binary files; some versions of OpenMVS read only text.

    Returns:
        Name of each face's image to the number of points that it observes. COLMAP does not fuse images without points.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    rigs = _add_rigs(model, [cuts[name].views for name in poses.names if name in cuts])
    points = ModelPoints(poses)
    seen: dict[str, int] = {}
    frame_id = 0
    for idx, name in enumerate(poses.names):
        if name not in cuts:
            continue
        frame_id += 1
        cut = cuts[name]
        rig_id, camera_ids = rigs[id(cut.views)]
        image_ids = [len(seen) + number + 1 for number in range(len(cut.views))]
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=rig_id)
        _add_frame(model, frame, dict(zip(image_ids, camera_ids, strict=True)), pose=_rig_pose(poses, idx, cut))
        observations = _by_face(poses.track_bearings, points.observations(idx), cut.views)
        for view, image_name, image_id, camera_id, (observed, pixels) in zip(
            cut.views, cut.image_names, image_ids, camera_ids, observations, strict=True
        ):
            image = pycolmap.Image(name=image_name, keypoints=pixels, camera_id=camera_id, image_id=image_id)
            image.frame_id = frame_id
            model.add_image(image)
            points.observe(image_id, observed, pixels_per_rad=view.focal_px)
            seen[image_name] = len(observed)
        model.register_frame(frame_id)
    if photographs is not None:
        add_photographs(model, photographs, first_camera=len(model.cameras) + 1, first_image=len(seen) + 1)
    points.add_to(model, only_seen=True)
    write_model(model, folder, form)
    return seen


def _add_rigs(model: Any, all_views: Sequence[Sequence[PinholeView]]) -> dict[int, tuple[int, list[int]]]:
    """Add a rig with cameras for each distinct sequence of faces; return the ids of both by the sequence's `id()`."""
    import pycolmap

    rigs: dict[int, tuple[int, list[int]]] = {}
    cameras = 0
    for views in all_views:
        if id(views) in rigs:
            continue
        rig = pycolmap.Rig(rig_id=len(rigs) + 1)
        camera_ids = [cameras + number + 1 for number in range(len(views))]
        cameras += len(views)
        for camera_id, view in zip(camera_ids, views, strict=True):
            _add_camera(model, camera_id, view)
            turn = view.view_from_cam @ views[0].view_from_cam.T
            if camera_id == camera_ids[0]:
                rig.add_ref_sensor(_sensor(camera_id))
            else:
                rig.add_sensor(_sensor(camera_id), pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3)))
        model.add_rig(rig)
        rigs[id(views)] = rig.rig_id, camera_ids
    return rigs


def _add_camera(model: Any, camera_id: int, view: PinholeView) -> None:
    import pycolmap

    height, width = view.size_hw
    params = [view.focal_px, view.focal_px, *view.principal_xy]
    model.add_camera(pycolmap.Camera(camera_id=camera_id, model="PINHOLE", width=width, height=height, params=params))


def _add_frame(model: Any, frame: Any, camera_of_image: Mapping[int, int], *, pose: Rigid3) -> None:
    import pycolmap

    for image_id, camera_id in camera_of_image.items():
        frame.add_data_id(pycolmap.data_t(_sensor(camera_id), image_id))
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
    model.add_frame(frame)


def _sensor(camera_id: int) -> Any:
    import pycolmap

    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def _rig_pose(poses: Poses, idx: int, cut: CutPanorama) -> Rigid3:
    return Rigid3(cut.views[0].view_from_cam, np.zeros(3)) @ poses.cam_from_world(idx)


def _by_face(
    bearings: FloatArray, observed: NDArray[np.intp], views: Sequence[PinholeView]
) -> list[tuple[NDArray[np.intp], FloatArray]]:
    """Return the track entries in each face and their pixels, (n, 2)."""
    rays = bearings[observed]
    owner = (rays @ np.array([view.view_from_cam[2] for view in views]).T).argmax(axis=1)
    by_face = []
    for face_idx, view in enumerate(views):
        of_face = np.flatnonzero(owner == face_idx)
        pixels = view.pixels_from_rays(rays[of_face]).reshape(-1, 2)
        inside = view.contains(pixels).reshape(-1)
        by_face.append((observed[of_face[inside]], pixels[inside]))
    return by_face
