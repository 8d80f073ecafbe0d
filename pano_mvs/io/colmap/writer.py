"""Write COLMAP models through pycolmap: of panoramas, of their faces, and of the fisheye pictures behind them."""

from __future__ import annotations

import json
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import FisheyeLens, LensRig, PinholeView, Rigid3, pixel_from_ray, quat_wxyz_from_rotation
from pano_mvs.scene import Poses
from pano_mvs.scene.photographs import Photographs

ModelForm = Literal["bin", "txt", "both"]


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
        poses: the poses. Errors are converted to pixels at the equator (w / 2π per radian).
        sizes_hw: (height, width) of each image by name.
        photographs: ordinary photographs, in the same world; see `_RigModel.add_photographs`.
        form: "bin" (COLMAP's default), "txt", or "both", of which COLMAP reads the binary files.

    Raises:
        UsageError: if the size of an image is missing.
    """
    missing = [name for name in poses.names if name not in sizes_hw]
    if missing:
        raise UsageError(f"the size of {missing[0]} is not given (nor of {len(missing) - 1} more)")
    model = _RigModel(poses)
    for name in poses.names:
        height, width = sizes_hw[name]
        # An EQUIRECTANGULAR camera without params aborts the process when it is used.
        model.add_rig((height, width), [_Camera("EQUIRECTANGULAR", (height, width), [width, height])])
    for idx, name in enumerate(poses.names):
        observed = model.points.observations(idx)
        pixels = pixel_from_ray(poses.track_bearings[observed], sizes_hw[name]).reshape(-1, 2)
        picture = _Picture(name, observed, pixels, sizes_hw[name][1] / (2 * np.pi))
        model.add_frame(sizes_hw[name], poses.cam_from_world(idx), [picture])
    model.add_photographs(photographs)
    model.write(folder, form, only_seen=False)


@dataclass(frozen=True, slots=True, eq=False)
class CutPanorama:
    """The faces of one panorama."""

    views: Sequence[PinholeView]  # the faces. Panoramas that share the same sequence object share a rig
    image_names: Sequence[str]  # names of the faces' images in the same order, relative to the image folder


@dataclass(frozen=True, slots=True, eq=False)
class LensPictures:
    """The fisheye pictures of one panorama."""

    rig: LensRig
    image_names: tuple[str, str]


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
        poses: poses of the panoramas with points and tracks. Errors become pixels at a face's centre (f per radian).
        cuts: panorama name to its faces; panoramas without an entry are omitted.
        photographs: ordinary photographs, in the same world; see `_RigModel.add_photographs`.
        form: "bin", "txt" or "both". COLMAP prefers binary files; some versions of OpenMVS read only text.

    Returns:
        Name of each image to the number of points that it observes. COLMAP does not fuse images without points.
    """
    model = _RigModel(poses)
    for name in poses.names:
        if name in cuts:
            views = cuts[name].views
            cameras = [_Camera("PINHOLE", v.size_hw, [v.focal_px, v.focal_px, *v.principal_xy]) for v in views]
            turns = [Rigid3(view.view_from_cam @ views[0].view_from_cam.T, np.zeros(3)) for view in views]
            model.add_rig(id(views), cameras, turns)
    for idx, name in enumerate(poses.names):
        if name in cuts:
            views = cuts[name].views
            by_face = _by_face(poses.track_bearings, model.points.observations(idx), views)
            pictures = [
                _Picture(image_name, observed, pixels, view.focal_px)
                for view, image_name, (observed, pixels) in zip(views, cuts[name].image_names, by_face, strict=True)
            ]
            first_from_world = Rigid3(views[0].view_from_cam, np.zeros(3)) @ poses.cam_from_world(idx)
            model.add_frame(id(views), first_from_world, pictures)
    model.add_photographs(photographs)
    return model.write(folder, form)


def write_lens_rig_model(
    folder: Path, poses: Poses, pictures: Mapping[str, LensPictures], *, form: ModelForm = "bin"
) -> Mapping[str, int]:
    """Write a COLMAP model of fisheye pictures: rigs, OPENCV_FISHEYE cameras, frames, points and tracks.

    The first lens defines the frame of the rig; `sensor_from_rig` of the second contains the distance of the lenses. An
    observation in a panorama becomes one of the lens that the panorama shows there. Observations more than 89° from the
    axis of their lens are omitted, because COLMAP's model cannot project beyond 90°, and so are points without others.

    Args:
        poses: poses of the panoramas, in metres, with points and tracks.
        pictures: panorama name to its pictures; panoramas without an entry are omitted.
        form: "bin", "txt" or "both".

    Returns:
        Image name to the number of points that it observes.

    Raises:
        UsageError: if the poses are not in metres, because the distance of the lenses is.
    """
    if not poses.metric:
        raise UsageError("poses must be in metres, because the distance of the lenses is: add poses.scale")
    model = _RigModel(poses)
    for name in poses.names:
        if name in pictures:
            rig = pictures[name].rig
            cameras = [_Camera("OPENCV_FISHEYE", lens.size_hw, _params(lens)) for lens in rig.lenses]
            model.add_rig(_calibration(rig), cameras, [Rigid3.identity(), second_from_first(rig)])
    for idx, name in enumerate(poses.names):
        if name in pictures:
            rig, observed = pictures[name].rig, model.points.observations(idx)
            bearings = poses.track_bearings[observed]
            labels = rig.lens_of_bearings(bearings)
            of_lenses = []
            for lens_idx, image_name in enumerate(pictures[name].image_names):
                kept, pixels = _pixels(rig, lens_idx, bearings, labels=labels)
                pixels_per_rad = float(np.mean(rig.lenses[lens_idx].focal_xy))
                of_lenses.append(_Picture(image_name, observed[kept], pixels, pixels_per_rad))
            model.add_frame(_calibration(rig), rig.lens_from_rig[0] @ poses.cam_from_world(idx), of_lenses)
    return model.write(folder, form)


def rig_configuration(rig: LensRig) -> str:
    """Return the JSON with which `colmap rig_configurator` applies the calibration to a database."""
    turn = second_from_first(rig)
    first, second = (
        {"image_prefix": f"{name}/", "camera_model_name": "OPENCV_FISHEYE", "camera_params": _params(lens)}
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


class _Camera(NamedTuple):
    """COLMAP's name of the model, (height, width), and its parameters."""

    model: str
    size_hw: tuple[int, int]
    params: list[float]


class _Picture(NamedTuple):
    """A picture of a frame, and the track entries (n,) that it observes at pixels (n, 2)."""

    name: str
    observed: NDArray[np.intp]
    pixels: FloatArray
    pixels_per_rad: float


class _RigModel:
    """A pycolmap model of rigs, whose cameras and images have ids in the order in which they are added."""

    def __init__(self, poses: Poses) -> None:
        import pycolmap

        self.model = pycolmap.Reconstruction()
        self.points = _ModelPoints(poses)  # the points of the poses
        self.seen: dict[str, int] = {}  # image name to the number of points that it observes
        self._rigs: dict[Hashable, tuple[int, list[int]]] = {}

    def add_rig(
        self, key: Hashable, cameras: Sequence[_Camera], from_first: Sequence[Rigid3] = (Rigid3.identity(),)
    ) -> None:
        """Add a rig with its cameras, unless it is known; `from_first` are the poses of the cameras in the first."""
        import pycolmap

        if key in self._rigs:
            return
        first_id = len(self.model.cameras) + 1
        # COLMAP's own rigs of one camera have the camera's id, and their frames the image's.
        rig = pycolmap.Rig(rig_id=first_id if len(cameras) == 1 else len(self._rigs) + 1)
        camera_ids = list(range(first_id, first_id + len(cameras)))
        for camera_id, (kind, (height, width), params), pose in zip(camera_ids, cameras, from_first, strict=True):
            self.model.add_camera(
                pycolmap.Camera(camera_id=camera_id, model=kind, width=width, height=height, params=params)
            )
            if camera_id == first_id:
                rig.add_ref_sensor(_sensor(camera_id))
            else:
                rig.add_sensor(_sensor(camera_id), _rigid(pose))
        self.model.add_rig(rig)
        self._rigs[key] = rig.rig_id, camera_ids

    def add_frame(self, key: Hashable, rig_from_world: Rigid3, pictures: Iterable[_Picture]) -> None:
        """Add a frame of a rig with the pictures of its cameras, in their order."""
        import pycolmap

        rig_id, camera_ids = self._rigs[key]
        frame_id = (len(self.seen) if len(camera_ids) == 1 else self.model.num_frames()) + 1
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=rig_id)
        taken = [
            (len(self.seen) + number, *each)
            for number, each in enumerate(zip(camera_ids, pictures, strict=True), start=1)
        ]
        for image_id, camera_id, _ in taken:
            frame.add_data_id(pycolmap.data_t(_sensor(camera_id), image_id))
        frame.rig_from_world = _rigid(rig_from_world)
        self.model.add_frame(frame)
        for image_id, camera_id, picture in taken:
            image = pycolmap.Image(name=picture.name, keypoints=picture.pixels, camera_id=camera_id, image_id=image_id)
            image.frame_id = frame_id
            self.model.add_image(image)
            self.points.observe(image_id, picture.observed, pixels_per_rad=picture.pixels_per_rad)
            self.seen[picture.name] = len(picture.pixels)
        self.model.register_frame(frame_id)

    def add_photographs(self, photographs: Photographs | None) -> None:
        """Add photographs without key points, each with a camera of its own.

        A photograph with distortion has a SIMPLE_RADIAL camera, one without a PINHOLE camera.
        """
        for idx, name in enumerate(photographs.names if photographs is not None else ()):
            assert photographs is not None
            height, width = photographs.sizes_hw[idx].tolist()
            focal, radial = photographs.focals_px[idx], photographs.radials[idx]
            params = [focal, width / 2, height / 2, radial] if radial else [focal, focal, width / 2, height / 2]
            self.add_rig(name, [_Camera("SIMPLE_RADIAL" if radial else "PINHOLE", (height, width), params)])
            nothing = _Picture(name, np.zeros(0, np.intp), np.zeros((0, 2)), 0.0)
            self.add_frame(name, photographs.cam_from_world(idx), [nothing])

    def write(self, folder: Path, form: ModelForm, *, only_seen: bool = True) -> Mapping[str, int]:
        """Write the model with the points, or those that an image observes; the folder is made. Return `seen`."""
        self.points.add_to(self.model, only_seen=only_seen)
        folder.mkdir(parents=True, exist_ok=True)
        if form in ("bin", "both"):
            self.model.write_binary(str(folder))
        if form in ("txt", "both"):
            self.model.write_text(str(folder))
        return self.seen


def _sensor(camera_id: int) -> Any:
    import pycolmap

    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def _calibration(rig: LensRig) -> str:
    return json.dumps(rig.to_values()["lenses"])


def _params(lens: FisheyeLens) -> list[float]:
    return [*lens.focal_xy, *lens.principal_xy, *lens.distortion]


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


def _pixels(
    rig: LensRig, lens_idx: int, bearings: FloatArray, *, labels: NDArray[np.int8]
) -> tuple[NDArray[np.intp], FloatArray]:
    """Return which bearings a lens observes, and their pixels in its picture, (n, 2)."""
    lens = rig.lenses[lens_idx]
    rays = rig.points_in_lens(bearings, lens_idx)
    # COLMAP's OPENCV_FISHEYE cannot project points at 90° from the axis or beyond.
    kept = np.flatnonzero((labels == lens_idx) & (lens.angle_from_axis(rays) < np.radians(89.0)))
    return kept, lens.pixel_from_ray(rays[kept]).reshape(-1, 2)


class _ModelPoints:
    """Collect the observations of images in tracks, and add the points to a pycolmap model."""

    def __init__(self, poses: Poses) -> None:
        import pycolmap

        self._poses = poses
        self._tracks: list[Any] = [pycolmap.Track() for _ in range(len(poses.points_in_world))]
        self._pixels_per_rad = np.zeros(len(self._tracks))
        order = np.argsort(poses.track_image_idx, kind="stable")
        ends = np.searchsorted(poses.track_image_idx[order], np.arange(len(poses.names) + 1))
        self._of_image = [order[first:end] for first, end in pairwise(ends)]

    def observations(self, image_idx: int) -> NDArray[np.intp]:
        """Return the indices of the track entries in one image of the poses, in order."""
        return self._of_image[image_idx]

    def observe(self, image_id: int, observed: NDArray[np.intp], *, pixels_per_rad: float) -> None:
        """Add observations: key points 0, 1, … of the model's image observe these track entries."""
        for point2d_idx, point_idx in enumerate(self._poses.track_point_idx[observed].tolist()):
            self._tracks[point_idx].add_element(image_id, point2d_idx)
            self._pixels_per_rad[point_idx] += pixels_per_rad

    def add_to(self, model: Any, *, only_seen: bool) -> None:
        """Add the points; with `only_seen`, only those that an image observes.

        The error of a point is its angle in pixels, averaged over the images that observe it.
        """
        poses = self._poses
        for idx, track in enumerate(self._tracks):
            if only_seen and not track.length():
                continue
            point_id = model.add_point3D(poses.points_in_world[idx], track, poses.point_colors_rgb[idx])
            per_rad = self._pixels_per_rad[idx] / max(track.length(), 1)
            model.points3D[point_id].error = float(poses.point_errors_rad[idx] * per_rad)


def _rigid(pose: Rigid3) -> Any:
    import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(pose.rotation)), np.asarray(pose.translation))
