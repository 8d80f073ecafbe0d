"""Read the panoramas of an E57 file (ASTM E2807, 8.4) and their poses."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from pano_mvs.api import InputError, Rigid3
from pye57 import libe57

# E57's camera has x forward, y left and z up (8.4.14.4 of the standard); ours x right, y down and z forward.
CAM_FROM_IMAGE = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

_SPHERE = "sphericalRepresentation"
_OTHERS = {
    "pinholeRepresentation": "of a pinhole camera",
    "cylindricalRepresentation": "on a cylinder",
    "visualReferenceRepresentation": "without a projection",
}
_SUFFIXES = {"jpegImage": ".jpg", "pngImage": ".png"}
_SUFFIX = re.compile(r"\.(jpe?g|png)$", re.IGNORECASE)
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)  # names of devices in Windows
_LONGEST_NAME = 80  # bytes, as file systems count
_NOT_IN_A_NAME = re.compile(r"[^\w.() +-]+")


@dataclass(frozen=True)
class StoredPanorama:
    """A spherical image of an E57 file.

    Attributes:
        name: unique in the file, with the suffix of its format.
        size_hw: (height, width) of its picture.
        source_size_hw: (height, width) of the full sphere at the same resolution.
        crop_ltwh: the part of the sphere that the picture covers, in pixels; None: all of it.
        cam_from_world: its pose in the coordinates of the file; None where the file has none.
    """

    name: str
    size_hw: tuple[int, int]
    source_size_hw: tuple[int, int]
    crop_ltwh: tuple[int, int, int, int] | None
    cam_from_world: Rigid3 | None


def list_panoramas(path: Path) -> tuple[list[StoredPanorama], list[str]]:
    """Return the spherical images of a file, and notes on its other images.

    Raises:
        InputError: if the file cannot be read as E57; it names the file.
    """
    with _opened(path) as file:
        panoramas = [_described(name, image, path) for name, image in _named_images(file)]
        others = Counter(kind for image in _images(file) for node, kind in _OTHERS.items() if image.isDefined(node))
    notes = [
        f"{path.name}: {count} {'image' if count == 1 else 'images'} {kind} {'is' if count == 1 else 'are'} not used: "
        "only spherical images are panoramas"
        for kind, count in others.items()
    ]
    return panoramas, notes


def read_picture(path: Path, name: str) -> tuple[bytes, bytes | None]:
    """Return the encoded picture of a panorama, and that of its mask (PNG, 0 where the picture is not valid) or None.

    Raises:
        InputError: if the file cannot be read or has no such panorama.
    """
    with _opened(path) as file:
        for found, image in _named_images(file):
            if found == name:
                sphere = image[_SPHERE]
                mask = _blob(sphere["imageMask"]) if sphere.isDefined("imageMask") else None
                return _blob(sphere[_format(sphere, path, name)]), mask
    raise InputError(f"{path}: has no spherical image {name}")


def _described(name: str, image: Any, path: Path) -> StoredPanorama:
    sphere = image[_SPHERE]
    where = f"{path}: image {name}"
    _format(sphere, path, name)
    height, width = (int(_number(sphere, key, where)) for key in ("imageHeight", "imageWidth"))
    steps = [_number(sphere, key, where) for key in ("pixelHeight", "pixelWidth")]
    if min(height, width, *steps) <= 0:
        raise InputError(f"{where}: its size is {width}×{height} px of {steps[1]:g}×{steps[0]:g} rad. Export it again")
    # As the middle of the picture is the x axis of the image, a part of the sphere is cut symmetrically (8.4.14.5).
    full_width = round(2 * np.pi / steps[1] / 2) * 2
    full_height = full_width // 2
    if width > full_width or height > full_height or abs(steps[0] - steps[1]) > 0.01 * steps[1]:
        raise InputError(
            f"{where}: {width}×{height} px of {steps[1]:g}×{steps[0]:g} rad are no part of an equirectangular panorama"
        )
    crop = ((full_width - width) // 2, (full_height - height) // 2, width, height)
    return StoredPanorama(
        name,
        (height, width),
        (full_height, full_width),
        None if crop[2:] == (full_width, full_height) else crop,
        _pose(image, where),
    )


def _pose(image: Any, where: str) -> Rigid3 | None:
    if not image.isDefined("pose"):
        return None
    pose = image["pose"]
    quaternion = [0.0, 0.0, 0.0, 1.0]  # the standard's default of both parts is not to move
    place = np.zeros(3)
    if pose.isDefined("rotation"):
        quaternion = [_number(pose["rotation"], key, where) for key in "xyzw"]
    if pose.isDefined("translation"):
        place = np.array([_number(pose["translation"], key, where) for key in "xyz"])
    if not np.isfinite([*quaternion, *place]).all() or np.linalg.norm(quaternion) < 1e-6:
        raise InputError(f"{where}: its pose has no finite numbers, or a quaternion of length 0. Export it again")
    rotation = CAM_FROM_IMAGE @ scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix().T
    return Rigid3(rotation, -rotation @ place)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    file = None
    try:
        file = libe57.ImageFile(str(path), "r")
        yield file
    except InputError:
        raise
    except Exception as error:  # libE57 raises exceptions of many kinds, with many lines
        why = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputError(f"{path}: cannot be read as E57 ({why}). Copy it, or export it, again") from error
    finally:
        if file is not None:
            file.close()


def _images(file: Any) -> list[Any]:
    root = file.root()
    images = root["images2D"] if root.isDefined("images2D") else []
    return [images[idx] for idx in range(len(images))]


def _named_images(file: Any) -> Iterator[tuple[str, Any]]:
    """Yield the spherical images with unique names: images need none, and several may have the same."""
    used = set[str]()
    for idx, image in enumerate(_images(file)):
        if not image.isDefined(_SPHERE):
            continue
        stated = image["name"].value() if image.isDefined("name") else ""
        written = _NOT_IN_A_NAME.sub("_", stated).strip(". ").encode()[:_LONGEST_NAME].decode(errors="ignore")
        stem = written or f"image_{idx:04d}"
        suffix = next((suffix for key, suffix in _SUFFIXES.items() if image[_SPHERE].isDefined(key)), ".jpg")
        stem = _SUFFIX.sub("", stem) or stem
        stem = f"image_{stem}" if _RESERVED.fullmatch(stem) else stem
        while stem.casefold() in used:
            stem = f"{stem}_{idx:04d}"
        used.add(stem.casefold())
        yield f"{stem}{suffix}", image


def _format(sphere: Any, path: Path, name: str) -> str:
    for key in _SUFFIXES:
        if sphere.isDefined(key):
            return key
    raise InputError(f"{path}: image {name} has neither a JPEG nor a PNG. Export it again")


def _number(node: Any, key: str, where: str) -> float:
    if not node.isDefined(key):
        raise InputError(f"{where}: {key} is missing. Export it again")
    return float(node[key].value())


def _blob(node: Any) -> bytes:
    data = bytearray(node.byteCount())
    node.read(data, 0, len(data))
    return bytes(data)
