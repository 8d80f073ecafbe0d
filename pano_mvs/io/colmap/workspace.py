"""The files of a COLMAP dense workspace, except its sparse model.

images/IMAGE_FACE.jpg
masks/IMAGE_FACE.jpg.png                            255 valid, 0 ignored
stereo/depth_maps/IMAGE_FACE.jpg.geometric.bin      z-depth, 0 unknown
stereo/normal_maps/IMAGE_FACE.jpg.geometric.bin     in the face's camera frame
stereo/patch-match.cfg, stereo/fusion.cfg           the list of images
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_file import write_png

WORKSPACE = "colmap_dense"


def face_image_name(face: str, item: str, suffix: str) -> str:
    """Return the name of a face's image in the model: `a/b_front.jpg` for the image `a/b`.

    The face is in the file name and not in the folder, because splat trainers ignore folders. Names of faces do not
    contain `_`, so that names are distinct.
    """
    return f"{item}_{face}{suffix}"


def write_face(
    scratch: Path,
    face: str,
    suffix: str,
    *,
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    z_depth: NDArray[np.float32],
    normals_in_face: NDArray[np.float32],
) -> dict[str, Path]:
    """Write the four files of one face of one panorama, and return their paths by target in the output folder.

    Args:
        suffix: suffix of the image, ".jpg" or ".png".
        image: (h, w, 3) uint8 RGB.
        mask: (h, w) bool, False is ignored.
        z_depth: (h, w) float32, NaN unknown.
        normals_in_face: (h, w, 3) float32 in the face's camera frame, NaN unknown.
    """
    name = face_image_name(face, "{item}", suffix)
    targets = {
        f"{WORKSPACE}/images/{name}": scratch / f"{face}{suffix}",
        f"{WORKSPACE}/masks/{name}.png": scratch / f"{face}.mask.png",
        f"{WORKSPACE}/stereo/depth_maps/{name}.geometric.bin": scratch / f"{face}.depth.bin",
        f"{WORKSPACE}/stereo/normal_maps/{name}.geometric.bin": scratch / f"{face}.normal.bin",
    }
    picture, mask_file, depth_file, normal_file = targets.values()
    write_picture(picture, image)
    write_png(mask_file, mask.astype(np.uint8) * 255)
    write_depth_map(depth_file, z_depth)
    write_normal_map(normal_file, normals_in_face)
    return targets


def sparse_targets(files: Iterable[Path]) -> dict[str, Path]:
    """Return the targets of the files of the model in the output folder: in sparse/ and again in sparse/0.

    COLMAP's dense tools and OpenMVS read the former, splat trainers the latter.
    """
    return {f"{WORKSPACE}/{folder}/{path.name}": path for folder in ("sparse", "sparse/0") for path in files}


def write_stereo_configs(scratch: Path, image_names: Iterable[str]) -> dict[str, Path]:
    """Write patch-match.cfg and fusion.cfg for images in order, and return their paths by target."""
    names = list(image_names)
    targets = {
        f"{WORKSPACE}/stereo/patch-match.cfg": scratch / "patch-match.cfg",
        f"{WORKSPACE}/stereo/fusion.cfg": scratch / "fusion.cfg",
    }
    match_file, fusion_file = targets.values()
    # As COLMAP's image_undistorter writes it.
    match_file.write_text("".join(f"{name}\n__auto__, 20\n" for name in names), encoding="utf-8")
    fusion_file.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    return targets


_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,2})&")


def write_depth_map(path: Path, z_depth: NDArray[np.float32]) -> None:
    """Write z-depths (H, W) float32; NaN becomes COLMAP's 0."""
    if z_depth.ndim != 2 or z_depth.dtype != np.float32:
        raise UsageError(f"a depth map is (H, W) float32, got {z_depth.shape} {z_depth.dtype}")
    _write(path, z_depth[..., None])


def write_normal_map(path: Path, normals_in_cam: NDArray[np.float32]) -> None:
    """Write normals (H, W, 3) float32 in the picture's camera frame; NaN becomes (0, 0, 0)."""
    if normals_in_cam.ndim != 3 or normals_in_cam.shape[2] != 3 or normals_in_cam.dtype != np.float32:
        raise UsageError(f"a normal map is (H, W, 3) float32, got {normals_in_cam.shape} {normals_in_cam.dtype}")
    _write(path, normals_in_cam)


def read_colmap_map(path: Path) -> NDArray[np.float32]:
    """Return a depth map (H, W) or a normal map (H, W, 3) as stored in the file: 0 where unknown.

    Raises:
        InputError: if the file cannot be read or is not such a map.
    """
    data = FilePart(path).read_bytes()
    header = _HEADER.match(data)
    width, height, channels = (int(number) for number in header.groups()) if header else (0, 0, 0)
    if header is None or len(data) != header.end() + 4 * width * height * channels:
        raise InputError(f"{path}: not a complete depth or normal map of COLMAP. Write it again")
    planes = np.frombuffer(data, "<f4", offset=header.end()).reshape(channels, height, width)
    return np.ascontiguousarray(planes[0] if channels == 1 else np.moveaxis(planes, 0, -1), np.float32)


def _write(path: Path, values: NDArray[np.float32]) -> None:
    """Write (H, W, C) as planes."""
    height, width, channels = values.shape
    planes = np.ascontiguousarray(np.moveaxis(np.nan_to_num(values, nan=0.0), -1, 0), "<f4")
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + planes.tobytes())


_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
_WRITABLE = (".bmp", ".tif", ".tiff", ".webp")


def write_picture(path: Path, picture: NDArray[np.uint8], size_hw: tuple[int, int] | None = None) -> None:
    """Write an image (H, W, 3) uint8 RGB in the format of the path's suffix; other formats become JPEG (quality 95)."""
    if size_hw is not None and picture.shape[:2] != size_hw:
        enlarged = size_hw[1] > picture.shape[1]
        way = cv2.INTER_CUBIC if enlarged else cv2.INTER_AREA
        picture = np.asarray(cv2.resize(picture, size_hw[::-1], interpolation=way), np.uint8)
    suffix = path.suffix.lower()
    if suffix == ".png":
        write_png(path, picture)
        return
    kind, options = (suffix, []) if suffix in _WRITABLE else (".jpg", _JPEG)
    path.write_bytes(cv2.imencode(kind, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)[1].tobytes())
