"""Poses of SphereSfM's models, which are like COLMAP's but have their own camera model.

SphereSfM, a fork of COLMAP, writes panoramas as camera model SPHERE, number 11 with three parameters (f, cx, cy). In
COLMAP, number 11 is another model with more parameters, so that pycolmap cannot read the files. The camera frame is
the same as ours.
"""

from __future__ import annotations

import struct
from pathlib import Path

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file
from pano_mvs.io.colmap.model_reader import read_images
from pano_mvs.io.images.captures import natural_key
from pano_mvs.io.poses.json_files import require_distinct
from pano_mvs.scene import Poses

_SPHERE_NAME, _SPHERE_ID, _SPHERE_PARAMS = "SPHERE", 11, 3
_CAMERA = struct.Struct("<IiQQ3d")
_COUNT = struct.Struct("<Q")


def has_sphere_cameras(folder: Path) -> bool:
    """Return whether all cameras of a model are SphereSfM's SPHERE, by number and parameters."""
    try:
        if is_file(folder / "cameras.bin"):
            return _is_sphere_binary((folder / "cameras.bin").read_bytes())
        lines = _content_lines(folder / "cameras.txt")
    except OSError as error:
        raise InputError(f"{folder}: the cameras cannot be read ({error.strerror})") from error
    except UnicodeDecodeError:
        return False
    return bool(lines) and all(line.split()[1:2] == [_SPHERE_NAME] for _, line in lines)


def read_sphere_model(folder: Path) -> Poses:
    """Return the poses of a SphereSfM model without its points, in its own world and unit.

    Args:
        folder: contains cameras and images as .bin or .txt. Images are sorted in the natural order of names.

    Raises:
        InputError: if the images cannot be read, or the model has no image.
    """
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


def _is_sphere_binary(data: bytes) -> bool:
    if len(data) < _COUNT.size:
        return False
    (count,) = _COUNT.unpack_from(data)
    if count == 0 or len(data) != _COUNT.size + count * _CAMERA.size:
        return False
    return all(_CAMERA.unpack_from(data, _COUNT.size + n * _CAMERA.size)[1] == _SPHERE_ID for n in range(count))


def _content_lines(path: Path) -> list[tuple[int, str]]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [(idx, line) for idx, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
