"""Clouds coloured by their errors, for CloudCompare and MeshLab."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.clouds.overview import distance_colors

_VERTEX = np.dtype([
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("distance", "<f4"),
])  # fmt: skip
_PLY_TYPES = {"f": "float", "u": "uchar"}


def write_error_cloud(
    path: Path,
    points: Iterable[NDArray[np.float32]],
    distances: NDArray[np.float32],
    *,
    limits: Sequence[float],
    farthest: float,
) -> None:
    """Write points as binary little-endian PLY: x y z, red green blue, and their distance as a scalar (float).

    Args:
        path: the file to write; its folder is made.
        points: the points in chunks (K, 3), N in all, one in memory at a time.
        distances: (N,) of each; infinite beyond `farthest`, which is what is written for them.
        limits: tolerances in rising order, by which points are coloured as of `distance_colors`.
        farthest: the largest distance that was told apart.

    Raises:
        UsageError: if there are not N points.
    """
    properties = "".join(f"property {_PLY_TYPES[_VERTEX[name].kind]} {name}\n" for name in _VERTEX.names or ())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(distances)}\n{properties}end_header\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    start = 0
    with path.open("wb") as stream:
        stream.write(head.encode())
        for chunk in points:
            part = distances[start : start + len(chunk)]
            start += len(chunk)
            stream.write(_vertices(chunk, part, limits, farthest).tobytes())
    if start != len(distances):
        raise UsageError(f"{start} points, but {len(distances)} distances")


def _vertices(
    points: NDArray[np.float32], distances: NDArray[np.float32], limits: Sequence[float], farthest: float
) -> NDArray[np.void]:
    vertices = np.zeros(len(distances), _VERTEX)
    for idx, name in enumerate("xyz"):
        vertices[name] = points[: len(distances), idx]
    colors = distance_colors(distances, limits)
    for idx, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, idx]
    vertices["distance"] = np.minimum(distances, np.float32(farthest))
    return vertices
