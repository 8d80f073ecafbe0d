"""The files of a COLMAP dense workspace, except its sparse model.

images/IMAGE_FACE.jpg
masks/IMAGE_FACE.jpg.png                            255 valid, 0 ignored
stereo/depth_maps/IMAGE_FACE.jpg.geometric.bin      z-depth, 0 unknown
stereo/normal_maps/IMAGE_FACE.jpg.geometric.bin     in the face's camera frame
stereo/patch-match.cfg, stereo/fusion.cfg           the list of images
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.colmap.image_copies import write_picture
from pano_mvs.io.colmap.maps import write_depth_map, write_normal_map
from pano_mvs.scene.image_files.image_file import write_png

WORKSPACE = "colmap_dense"
_SOURCES = 20  # as COLMAP's image_undistorter writes


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
        scratch: the folder to write to.
        face: the name of the face.
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
    match_file.write_text("".join(f"{name}\n__auto__, {_SOURCES}\n" for name in names), encoding="utf-8")
    fusion_file.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    return targets
