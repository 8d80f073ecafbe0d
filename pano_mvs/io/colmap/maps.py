"""COLMAP's depth and normal maps: `stereo/depth_maps/*.bin` and `stereo/normal_maps/*.bin`.

A file is the text `width&height&channels&` and then float32 planes, little endian, channel by channel, row by row.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.scene import FilePart

_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,2})&")


def write_depth_map(path: Path, z_depth: NDArray[np.float32]) -> None:
    """Write z-depths (H, W) float32; NaN becomes COLMAP's 0.

    Raises:
        UsageError: if the array has another shape or type.
    """
    if z_depth.ndim != 2 or z_depth.dtype != np.float32:
        raise UsageError(f"a depth map is (H, W) float32, got {z_depth.shape} {z_depth.dtype}")
    _write(path, z_depth[..., None])


def write_normal_map(path: Path, normals_in_cam: NDArray[np.float32]) -> None:
    """Write normals (H, W, 3) float32 in the picture's camera frame; NaN becomes (0, 0, 0).

    Raises:
        UsageError: if the array has another shape or type.
    """
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
