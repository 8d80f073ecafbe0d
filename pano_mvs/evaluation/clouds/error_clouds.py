"""Clouds coloured by their errors, for CloudCompare and MeshLab."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError

_COLORS = ("red", "green", "blue")
_VERTEX = np.dtype([*((name, "<f4") for name in "xyz"), *((name, "u1") for name in _COLORS), ("distance", "<f4")])
_PLY_TYPES = {"f": "float", "u": "uchar"}
# From correct to wrong, distinguishable for colour-blind readers.
_NEAREST, _FARTHEST, _BEYOND = np.array([38, 130, 142]), np.array([240, 190, 60]), (190, 30, 45)
_NOT_COUNTED = (205, 205, 205)


def distance_colors(distances: NDArray[np.float32], limits: Sequence[float]) -> NDArray[np.uint8]:
    """Return the colour, (..., 3) uint8 RGB, of each distance (...,).

    Distances within the smallest limit are dark, those within the largest light, and larger ones red; NaN is grey.
    """
    shares = np.linspace(0, 1, len(limits))[:, None]
    table = np.vstack([(1 - shares) * _NEAREST + shares * _FARTHEST, _BEYOND]).astype(np.uint8)
    level = np.searchsorted(np.asarray(limits, np.float32), distances.clip(0, np.float32(3e38)))
    colors = table[level.clip(0, len(limits))]
    colors[np.isnan(distances)] = _NOT_COUNTED
    return np.asarray(colors)


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
        points: the points in chunks (K, 3), N in all, one chunk in memory at a time.
        distances: (N,) of each; larger ones than `farthest` are written as `farthest`.
        limits: tolerances in rising order, for the colours (see `distance_colors`).
        farthest: the largest distance that was measured.

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
            vertices = np.zeros(len(part), _VERTEX)
            columns = (*chunk[: len(part)].T, *distance_colors(part, limits).T)
            for name, column in zip((*"xyz", *_COLORS), columns, strict=True):
                vertices[name] = column
            vertices["distance"] = np.minimum(part, np.float32(farthest))
            stream.write(vertices.tobytes())
    if start != len(distances):
        raise UsageError(f"{start} points, but {len(distances)} distances")
