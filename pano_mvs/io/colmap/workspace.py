"""The files of a COLMAP dense workspace, beside its sparse model.

images/IMAGE_FACE.jpg
masks/IMAGE_FACE.jpg.png                            255 valid, 0 ignored
stereo/depth_maps/IMAGE_FACE.jpg.geometric.bin      z-depth, 0 unknown
stereo/normal_maps/IMAGE_FACE.jpg.geometric.bin     in the face's camera frame
stereo/patch-match.cfg, stereo/fusion.cfg           which pictures there are
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.colmap.images import write_picture
from pano_mvs.io.colmap.maps import write_depth_map, write_normal_map
from pano_mvs.scene.image_files.image_file import write_png

WORKSPACE = "colmap_dense"
_SOURCES = 20  # what COLMAP's own undistorter writes


def face_image_name(face: str, item: str, suffix: str) -> str:
    """Return the name of a face's picture in the model: `a/b_front.jpg` of the image `a/b`.

    Splat trainers look at the last part of the name alone, so it is not the folder that tells the faces apart. Names of
    faces hold no `_`, so that no two pictures share a name.
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
    """Write the four files of one face of one panorama, and return where in the output folder each belongs.

    Args:
        scratch: a folder to write into.
        face: name of the face.
        suffix: of the picture, ".jpg" or ".png".
        image: (h, w, 3) uint8 RGB.
        mask: (h, w) bool, False is to be ignored.
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
    """Return where in the output folder the files of the model belong: in sparse/ and again in sparse/0.

    COLMAP's dense tools and OpenMVS look in the one, splat trainers in the other.
    """
    return {f"{WORKSPACE}/{folder}/{path.name}": path for folder in ("sparse", "sparse/0") for path in files}


def write_stereo_configs(scratch: Path, image_names: Iterable[str]) -> dict[str, Path]:
    """Write patch-match.cfg and fusion.cfg for pictures in order, and return where each belongs."""
    names = list(image_names)
    targets = {
        f"{WORKSPACE}/stereo/patch-match.cfg": scratch / "patch-match.cfg",
        f"{WORKSPACE}/stereo/fusion.cfg": scratch / "fusion.cfg",
    }
    match_file, fusion_file = targets.values()
    match_file.write_text("".join(f"{name}\n__auto__, {_SOURCES}\n" for name in names), encoding="utf-8")
    fusion_file.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    return targets
