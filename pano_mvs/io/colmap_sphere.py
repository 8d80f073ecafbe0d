"""Poses of SphereSfM's models, which look like COLMAP's but number a camera of their own.

SphereSfM, a fork of COLMAP, writes panoramas as camera model SPHERE, number 11 with three parameters (f, cx, cy). In
COLMAP number 11 is another model with more of them, so that pycolmap cannot read the files. The camera frame is ours.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file
from pano_mvs.geometry import Rigid3, rotation_from_quat_wxyz
from pano_mvs.io.captures import natural_key
from pano_mvs.io.pose_json import require_distinct, rigid_from_arrays
from pano_mvs.scene import Poses

_SPHERE_NAME, _SPHERE_ID, _SPHERE_PARAMS = "SPHERE", 11, 3
_CAMERA = struct.Struct("<IiQQ3d")
_COUNT = struct.Struct("<Q")
_IMAGE = struct.Struct("<I7dI")
_BYTES_PER_POINT2D = 24


def has_sphere_cameras(folder: Path) -> bool:
    """Return whether the cameras of a COLMAP model are all SphereSfM's SPHERE, told by number and parameters."""
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
    """Return the images of SphereSfM's model, without its points, in its own world and unit.

    Args:
        folder: holds cameras and images as .bin or .txt; images come in the natural order of their names.

    Raises:
        InputError: if the images cannot be read, or there is none.
    """
    binary = folder / "images.bin"
    path = binary if is_file(binary) else folder / "images.txt"
    try:
        found = list(_binary_images(path) if path == binary else _text_images(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: the images cannot be read ({error}). Is the file complete?") from error
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


def _binary_images(path: Path) -> Iterator[tuple[str, Rigid3]]:
    data = path.read_bytes()
    (count,) = _COUNT.unpack_from(data)
    offset = _COUNT.size
    for _ in range(count):
        values = _IMAGE.unpack_from(data, offset)
        end = data.index(b"\0", offset + _IMAGE.size)
        name = data[offset + _IMAGE.size : end].decode()
        (points,) = _COUNT.unpack_from(data, end + 1)
        offset = end + 1 + _COUNT.size + points * _BYTES_PER_POINT2D
        if offset > len(data):
            raise InputError(f"{path}: ends within image {name!r}. Is the file complete?")
        yield _posed(name, np.array(values[1:8]), f"{path} ({name})")


def _text_images(path: Path) -> Iterator[tuple[str, Rigid3]]:
    """Yield the poses of an images.txt: two lines for each image, the second its key points, which may be empty."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    for line in lines[::2]:
        cells = line.split(maxsplit=9)
        if not cells:
            continue
        if len(cells) < 10:
            raise InputError(f"{path}: expected an id, a quaternion, a translation, a camera and a name, got {line!r}")
        yield _posed(cells[9], np.array([float(cell) for cell in cells[1:8]]), f"{path} ({cells[9]})")


def _posed(name: str, numbers: np.ndarray, where: str) -> tuple[str, Rigid3]:
    quat_wxyz = numbers[:4]
    if not np.isfinite(quat_wxyz).all() or np.linalg.norm(quat_wxyz) < 1e-6:
        raise InputError(f"{where}: its quaternion is no rotation")
    return name, rigid_from_arrays(rotation_from_quat_wxyz(quat_wxyz), numbers[4:], where)


def _content_lines(path: Path) -> list[tuple[int, str]]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [(idx, line) for idx, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
