"""Read the files of a COLMAP sparse model: cameras, images and points3D, as .bin or as .txt.

Counts and references in the files are checked, and errors name the file and the entry. (pycolmap allocates as many
entries as a file states, and aborts the process if a camera lacks parameters.) Formats: COLMAP's documentation,
"Output Format".

SphereSfM, a fork of COLMAP, writes panoramas as camera model SPHERE, number 11 with three parameters (f, cx, cy). In
COLMAP, number 11 is another model with more parameters, so that pycolmap cannot read the files. The camera frame is
the same as ours.

pycolmap's `panorama_sfm` cuts panoramas into pinhole images pano_camera0/…, pano_camera1/… of a rig without a camera
for the panorama itself, whose pose follows from the turns of these virtual cameras.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file
from pano_mvs.geometry import Rigid3, ray_from_pixel, rotation_from_quat_wxyz, rotation_from_rotvec
from pano_mvs.io.images.captures import natural_key
from pano_mvs.io.poses.json_files import require_distinct, rigid_from_arrays
from pano_mvs.scene import Poses

MODEL_FILES = (("cameras.bin", "images.bin", "points3D.bin"), ("cameras.txt", "images.txt", "points3D.txt"))
"""The files of a model in its two forms, of which COLMAP prefers the first."""

CAMERA_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)
"""COLMAP's camera models in the order of their numbers."""

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT2D = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])
_POINT3D = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
_TRACK = np.dtype([("image_id", "<u4"), ("point2d_idx", "<u4")])
# The images of pycolmap's `panorama_sfm`, and the pitches of its virtual cameras: overlapping, not overlapping.
_VIRTUAL = re.compile(r"pano_camera(?P<number>\d{1,3})/(?P<panorama>.+)")
_PITCHES_DEG = ((0.0,), (-35.0, 0.0, 35.0))
_SPHERE_ID, _SPHERE_CAMERA = 11, struct.Struct("<IiQQ3d")


@dataclass(frozen=True, slots=True)
class ModelCamera:
    """One camera."""

    model: str
    size_hw: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class ModelImage:
    """One registered image."""

    name: str  # of the file, relative to the folder of the images
    quat_wxyz: NDArray[np.float64]  # rotation of cam_from_world as stored, (4,)
    translation: NDArray[np.float64]  # of cam_from_world, (3,)
    camera_id: int
    pixels: NDArray[np.float64]  # (n, 2), its key points
    point_ids: NDArray[np.int64]  # (n,), the point that each key point observes; negative without one
    where: str  # the file and the image, for error messages

    def cam_from_world(self) -> Rigid3:
        """Return the pose.

        Raises:
            InputError: if a number is not finite, or the quaternion is not a rotation.
        """
        if not (np.isfinite(self.quat_wxyz).all() and np.isfinite(self.translation).all()):
            raise InputError(f"{self.where}: the pose holds NaN or infinite numbers")
        if not 1e-6 < np.abs(self.quat_wxyz).max() < 1e100:
            raise InputError(f"{self.where}: its quaternion is not a rotation")
        return rigid_from_arrays(rotation_from_quat_wxyz(self.quat_wxyz), self.translation, self.where)


@dataclass(frozen=True, slots=True, eq=False)
class ModelPoints3D:
    """All points."""

    ids: NDArray[np.int64]  # (N,), increasing
    xyz: NDArray[np.float64]  # (N, 3)
    rgb: NDArray[np.uint8]  # (N, 3) uint8
    errors_px: NDArray[np.float64]  # (N,), mean reprojection errors; −1 if unknown
    track_lengths: NDArray[np.int64]  # (N,), number of observations
    track_image_ids: NDArray[np.int64]  # the images of all observations, ordered by point


def read_colmap_model(folder: Path) -> Poses:
    """Return the registered images, points and tracks of a COLMAP model of panoramas, in its own world and unit.

    Images of other cameras, such as localised photographs, are left out. From SphereSfM's models, whose cameras are
    SPHERE, and from models of the virtual cameras of pycolmap's panorama_sfm, only the poses are read.

    Raises:
        InputError: if the model cannot be read, has no EQUIRECTANGULAR camera, or registers no image.
    """
    if is_colmap_model(folder) and _has_sphere_cameras(folder):
        return _read_sphere_model(folder)
    files = model_files(folder)
    if files is None:
        raise InputError(
            f"{folder}: no COLMAP model here. Give the folder that holds cameras, images and points3D as "
            ".bin or .txt (often sparse/0)"
        )
    cameras = read_cameras(files[0])
    panoramic = {camera_id for camera_id, camera in cameras.items() if camera.model == "EQUIRECTANGULAR"}
    if cameras and not panoramic:
        images = list(read_images(files[1]).values())
        if any(_VIRTUAL.fullmatch(image.name) for image in images):
            return _read_virtual_cameras(images, files[1])
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


def _has_sphere_cameras(folder: Path) -> bool:
    """Return whether all cameras of a model are SphereSfM's SPHERE, by number and parameters."""
    try:
        if is_file(folder / "cameras.bin"):
            data = (folder / "cameras.bin").read_bytes()
            whole = len(data) > _COUNT.size and (len(data) - _COUNT.size) % _SPHERE_CAMERA.size == 0
            count = (len(data) - _COUNT.size) // _SPHERE_CAMERA.size
            return (
                whole
                and _COUNT.unpack_from(data)[0] == count
                and all(camera[1] == _SPHERE_ID for camera in _SPHERE_CAMERA.iter_unpack(data[_COUNT.size :]))
            )
        models = [line.split()[1:2] for line in _lines(folder / "cameras.txt")]
    except OSError as error:
        raise InputError(f"{folder}: the cameras cannot be read ({error.strerror})") from error
    except UnicodeDecodeError:
        return False
    return bool(models) and all(model == ["SPHERE"] for model in models)


def _read_sphere_model(folder: Path) -> Poses:
    """Return the poses of a SphereSfM model without its points, in its own world and unit."""
    binary = folder / "images.bin"
    path = binary if is_file(binary) else folder / "images.txt"
    found = [(image.name, image.cam_from_world()) for image in read_images(path).values()]
    require_distinct([name for name, _ in found], path)
    return Poses.without_points(
        dict(sorted(found, key=lambda item: natural_key(item[0]))),
        frame="the world of the SphereSfM model",
        scale="the unit of the SphereSfM model",
        metric=False,
    )


def _read_virtual_cameras(images: Sequence[ModelImage], path: Path) -> Poses:
    """Return the poses of the panoramas whose virtual cameras a model registers, in its own world and unit.

    Other images are rejected.
    """
    by_panorama: dict[str, dict[int, Rigid3]] = {}
    others: list[str] = []
    for image in images:
        if match := _VIRTUAL.fullmatch(image.name):
            by_panorama.setdefault(match["panorama"], {})[int(match["number"])] = image.cam_from_world()
        else:
            others.append(image.name)
    count = 1 + max(number for cameras in by_panorama.values() for number in cameras)
    layouts = [cams_from_pano for pitches_deg in _PITCHES_DEG if len(cams_from_pano := _ring(pitches_deg)) >= count]
    fitting = (
        turned for layout in layouts if (turned := _panoramas_of_virtual_cameras(by_panorama, layout)) is not None
    )
    # One virtual camera of each panorama fits any arrangement.
    poses = next(fitting, None) if max(map(len, by_panorama.values())) > 1 else None
    if poses is None:
        raise InputError(
            f"{path}: the images pano_camera0/… are not turned against each other as the virtual cameras of pycolmap's "
            "panorama_sfm are, or there is one of each panorama only, so the poses of the panoramas are unknown. Give "
            "the model sparse_equirectangular/0, which its newer versions write beside this one"
        )
    return Poses.without_points(
        dict(sorted(poses.items(), key=lambda item: natural_key(item[0]))),
        rejected={
            name: "it is not an image of a panorama's virtual camera (pano_camera0/…)"
            for name in sorted(others, key=natural_key)
            if name not in poses
        },
        frame="the world of the COLMAP model",
        scale="the unit of the COLMAP model",
        metric=False,
    )


def _ring(pitches_deg: Sequence[float]) -> list[NDArray[np.float64]]:
    """Return cam_from_pano of the virtual cameras: four around at each pitch, by half a step on for those above."""
    return [
        rotation_from_rotvec([np.deg2rad(-pitch), 0, 0])
        @ rotation_from_rotvec([0, -np.deg2rad(yaw + 45 * (pitch > 0)), 0])
        for pitch in pitches_deg
        for yaw in (0, 90, 180, 270)
    ]


def _panoramas_of_virtual_cameras(
    by_panorama: Mapping[str, Mapping[int, Rigid3]], cams_from_pano: Sequence[NDArray[np.float64]]
) -> dict[str, Rigid3] | None:
    """Return the poses of panoramas by those of their virtual cameras, or None if these are arranged otherwise."""
    poses = {}
    for name, cameras in by_panorama.items():
        found = [Rigid3(cams_from_pano[number].T, np.zeros(3)) @ camera for number, camera in cameras.items()]
        poses[name] = found[0]
        # Cameras of a rig share their centre and are turned exactly; text has twelve digits or so.
        size = 1 + float(np.abs(found[0].translation).max())
        for other in found[1:]:
            same = np.allclose(other.rotation, found[0].rotation, rtol=0, atol=1e-6)
            if not (same and np.allclose(other.translation, found[0].translation, rtol=0, atol=1e-6 * size)):
                return None
    return poses


def _pose(image: ModelImage) -> Rigid3:
    pose = image.cam_from_world()
    if np.abs(image.quat_wxyz).max() > 2 or abs(np.linalg.norm(image.quat_wxyz) - 1) > 1e-3:
        raise InputError(f"{image.where}: the length of its quaternion is not 1. Write the model again")
    return pose


def _observations(
    image: ModelImage, camera: ModelCamera, points: ModelPoints3D, *, path: Path
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the points that an image observes, and the bearings of the observations."""
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
    """Return the errors of points as angles, by the mean width of the images that observe each; 0 if unknown."""
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
    errors[known] = np.minimum(points.errors_px[known], 1e9) * rad_per_px
    return errors.astype(np.float32)


def model_files(folder: Path) -> tuple[Path, Path, Path] | None:
    """Return the files with cameras, images and points in a folder, or None if it does not contain a model."""
    for names in MODEL_FILES:
        cameras, images, points = (folder / name for name in names)
        if all(is_file(path) for path in (cameras, images, points)):
            return cameras, images, points
    return None


def read_cameras(path: Path) -> dict[int, ModelCamera]:
    """Return the cameras by id, up to and including the first that is not EQUIRECTANGULAR."""
    with _damage_named(path):
        found = _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)
        cameras: dict[int, ModelCamera] = {}
        for camera_id, camera in found:
            cameras[camera_id] = camera
            if camera.model != "EQUIRECTANGULAR":
                break
            if not 0 < min(camera.size_hw) <= max(camera.size_hw) <= 1 << 24:
                height, width = camera.size_hw
                raise ValueError(f"camera {camera_id} has {width}×{height} px")
        return cameras


def read_images(path: Path) -> dict[int, ModelImage]:
    """Return the registered images by id."""
    with _damage_named(path):
        images: dict[int, ModelImage] = {}
        for image_id, image in _binary_images(path) if path.suffix == ".bin" else _text_images(path):
            if image_id in images:
                raise ValueError(
                    f"images {images[image_id].name[:80]!r} and {image.name[:80]!r} have the same id, {image_id}"
                )
            images[image_id] = image
        return images


def read_points(path: Path) -> ModelPoints3D:
    """Return the points.

    Raises:
        InputError: if the file cannot be read or ends early, or a point has no finite position or is listed twice.
    """
    with _damage_named(path):
        rows, lengths, tracks = _binary_points(path) if path.suffix == ".bin" else _text_points(path)
        lost = ~np.isfinite(rows["xyz"]).all(axis=1)
        if lost.any():
            raise ValueError(f"point {rows['id'][lost][0]} has no finite position")
        order = np.argsort(rows["id"], kind="stable")
        ids = rows["id"][order]
        if (ids[1:] == ids[:-1]).any():
            raise ValueError(f"point {ids[1:][ids[1:] == ids[:-1]][0]} is listed twice")
        starts = np.cumsum(lengths) - lengths
        within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths[order]) - lengths[order], lengths[order])
        entries = tracks[np.repeat(starts[order], lengths[order]) + within]
        return ModelPoints3D(
            ids.astype(np.int64),
            np.ascontiguousarray(rows["xyz"][order], np.float64),
            np.ascontiguousarray(rows["rgb"][order]),
            np.ascontiguousarray(rows["error"][order], np.float64),
            lengths[order],
            entries.astype(np.int64),
        )


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Convert errors that damaged files cause to errors that name the file."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Check that it exists and may be read") from error
    except (struct.error, ValueError, OverflowError, MemoryError) as error:
        if isinstance(error, InputError):
            raise
        text = "not a text file in UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)
        raise InputError(f"{path}: the COLMAP model cannot be read: {text}. Is it complete?") from error


def _entries(data: bytes, min_bytes: int) -> int:
    """Return the number of entries that a binary file states; the file must be long enough for them."""
    (count,) = _COUNT.unpack_from(data)
    if count * min_bytes > len(data) - _COUNT.size:
        raise ValueError(f"it states {count} entries, but has {len(data)} bytes")
    return int(count)


def _binary_cameras(path: Path) -> Iterator[tuple[int, ModelCamera]]:
    data = path.read_bytes()
    offset = _COUNT.size
    for _ in range(_entries(data, _CAMERA.size)):
        camera_id, number, width, height = _CAMERA.unpack_from(data, offset)
        known = 0 <= number < len(CAMERA_MODELS)
        yield camera_id, ModelCamera(CAMERA_MODELS[number] if known else f"camera model {number}", (height, width))
        offset += _CAMERA.size + 16  # the parameters of EQUIRECTANGULAR
        if offset > len(data):
            raise ValueError("it ends within a camera")


def _text_cameras(path: Path) -> Iterator[tuple[int, ModelCamera]]:
    for line in _lines(path):
        cells = line.split()
        if len(cells) < 4:
            raise ValueError(f"expected an id, a camera model, a width and a height, got {line[:80]!r}")
        yield _number(cells[0]), ModelCamera(cells[1][:80], (_number(cells[3]), _number(cells[2])))


def _binary_images(path: Path) -> Iterator[tuple[int, ModelImage]]:
    data = path.read_bytes()
    offset = _COUNT.size
    for number in range(count := _entries(data, _IMAGE.size + 1 + _COUNT.size)):
        image_id, *numbers, camera_id = _IMAGE.unpack_from(data, offset)
        end = data.find(b"\0", offset + _IMAGE.size)
        if end < 0:
            raise ValueError(f"it ends within the name of image {number + 1} of {count}")
        name = data[offset + _IMAGE.size : end].decode()
        (points,) = _COUNT.unpack_from(data, end + 1)
        start = end + 1 + _COUNT.size
        offset = start + points * _POINT2D.itemsize
        if offset > len(data):
            raise ValueError(f"it ends within image {name[:80]!r}")
        rows = np.frombuffer(data, _POINT2D, points, start)
        yield (
            image_id,
            _image(path, name, np.array(numbers), camera_id=camera_id, pixels=rows["xy"], point_ids=rows["point_id"]),
        )


def _text_images(path: Path) -> Iterator[tuple[int, ModelImage]]:
    """Yield the images of an images.txt, which has two lines per image; the second, its key points, may be empty."""
    with path.open(encoding="utf-8") as stream:
        for line in stream:
            cells = line.split(maxsplit=9)
            if not cells or line.startswith("#"):
                continue
            if len(cells) < 10:
                raise ValueError(
                    f"expected an id, a quaternion, a translation, a camera and a name, got {line.strip()[:80]!r}"
                )
            name = cells[9].rstrip()
            values = np.array([float(cell) for cell in next(stream, "").split()])
            if len(values) % 3:
                raise ValueError(f"the key points of image {name[:80]!r} are not three numbers each")
            rows = values.reshape(-1, 3)
            ids = np.where(np.abs(rows[:, 2]) < 2**53, rows[:, 2], -1).astype(np.int64)
            numbers = np.array([float(cell) for cell in cells[1:8]])
            yield (
                _number(cells[0]),
                _image(path, name, numbers, camera_id=_number(cells[8]), pixels=rows[:, :2], point_ids=ids),
            )


def _image(
    path: Path,
    name: str,
    numbers: NDArray[np.float64],
    *,
    camera_id: int,
    pixels: NDArray[np.float64],
    point_ids: NDArray[np.int64],
) -> ModelImage:
    if not np.isfinite(pixels[point_ids >= 0]).all():
        raise ValueError(f"image {name[:80]!r} has a key point without a finite position")
    return ModelImage(name, numbers[:4], numbers[4:], camera_id, pixels, point_ids, f"{path} ({name})")


def _binary_points(path: Path) -> tuple[NDArray[np.void], NDArray[np.int64], NDArray[np.uint32]]:
    """Return the points without tracks, the lengths of the tracks, and the image ids in the tracks."""
    data = path.read_bytes()
    fixed = _POINT3D.itemsize + _COUNT.size
    rows: list[bytes] = []
    tracks: list[bytes] = []
    offset = _COUNT.size
    for number in range(count := _entries(data, fixed)):
        (length,) = _COUNT.unpack_from(data, offset + _POINT3D.itemsize)
        end = offset + fixed + length * _TRACK.itemsize
        if end > len(data):
            raise ValueError(f"it ends within point {number + 1} of {count}")
        rows.append(data[offset : offset + _POINT3D.itemsize])
        tracks.append(data[offset + fixed : end])
        offset = end
    lengths = np.array([len(track) // _TRACK.itemsize for track in tracks], np.int64)
    return np.frombuffer(b"".join(rows), _POINT3D), lengths, np.frombuffer(b"".join(tracks), _TRACK)["image_id"]


def _text_points(path: Path) -> tuple[NDArray[np.void], NDArray[np.int64], NDArray[np.uint32]]:
    rows: list[tuple[int, list[float], list[int], float]] = []
    lengths: list[int] = []
    image_ids: list[int] = []
    for line in _lines(path):
        cells = line.split()
        if len(cells) < 8 or len(cells) % 2:
            raise ValueError(f"expected an id, a position, a colour, an error and a track, got {line[:80]!r}")
        rgb = [_number(cell, below=256) for cell in cells[4:7]]
        rows.append((_number(cells[0], below=1 << 63), [float(cell) for cell in cells[1:4]], rgb, float(cells[7])))
        image_ids.extend(_number(cell) for cell in cells[8::2])
        lengths.append(len(cells) // 2 - 4)
    points = np.array([(idx, tuple(xyz), tuple(rgb), error) for idx, xyz, rgb, error in rows], _POINT3D)
    return points, np.array(lengths, np.int64), np.array(image_ids, np.uint32)


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file except comments and empty lines."""
    with path.open(encoding="utf-8") as stream:
        for line in stream:
            if line.strip() and not line.startswith("#"):
                yield line.strip()


def _number(text: str, *, below: int = 1 << 32) -> int:
    """Return an integer from text."""
    if not 0 < len(text) <= 20 or not 0 <= int(text) < below:
        raise ValueError(f"{text[:40]!r} is not a number from 0 to {below - 1}")
    return int(text)
