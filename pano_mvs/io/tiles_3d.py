"""Clouds as 3D Tiles 1.1 (OGC 22-025r4): an octree of glTF files with points, each of which adds to those above it.

A tileset has z up, the glTF files in it y up (section "glTF transforms" of the specification). The colours of glTF's
vertices are linear (glTF 2.0, section 3.7.2.1), those of a cloud sRGB (IEC 61966-2-1).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry.geodesy import earth_from_lla, earth_from_local
from pano_mvs.io.meshes import ARRAY_BUFFER, unlit_document, write_glb_parts
from pano_mvs.scene import PointCloud

_UINT16, _POINTS = 5123, 0


class TilesetWriter:
    """The tiles of one tileset, written one after the other."""

    def __init__(self, folder: Path, cloud: PointCloud, file_from_world: FloatArray, *, tile_points: int) -> None:
        """Take the folder to write to, the cloud, the rotation (3, 3) into axes with z up, and the points of a tile."""
        self._folder = folder
        self._cloud = cloud
        self._tile_points = tile_points
        self._file_from_world = file_from_world
        self._bounds: dict[str, FloatArray] = {}
        self._errors: dict[str, float] = {}
        self.files: dict[str, Path] = {}  # paths of the tiles and the tileset, by name

    def add(self, name: str, chosen: NDArray[np.int64], size: float) -> None:
        """Write the points of one node of the octree as NAME.glb.

        Args:
            name: that of `OctreeNode`: the names of its parents are its beginnings.
            chosen: (K,) positions of the points in the cloud.
            size: the edge of its cube.
        """
        points = self._cloud.points_in_world[chosen] @ self._file_from_world.T.astype(np.float32)
        self._bounds[name] = np.array([points.min(axis=0), points.max(axis=0)], np.float64)
        # By default, viewers load the tiles below another one if its error covers more than 16 pixels
        # (`maximumScreenSpaceError`, `errorTarget`): its points are then two pixels apart.
        self._errors[name] = 8.0 * size / np.sqrt(self._tile_points)  # half of that above it
        self.files[f"{name}.glb"] = self._folder / f"{name}.glb"
        write_points_glb(self.files[f"{name}.glb"], points, self._cloud.colors_rgb[chosen])

    def finish(self, about: dict[str, Any], origin_lla: Sequence[float] | None) -> None:
        """Write tileset.json.

        Args:
            about: `extras` of the tileset.
            origin_lla: latitude, longitude (degrees) and altitude (m) of the world's origin, whose axes are then x
                east, y down and z north; None if the place on the Earth is not known.
        """
        tiles: dict[str, dict[str, Any]] = {
            name: {"boundingVolume": {}, "geometricError": 0, "content": {"uri": f"{name}.glb"}}
            for name in self._bounds
        }
        for name in sorted(tiles, key=len, reverse=True):
            tile, (low, high) = tiles[name], self._bounds[name]
            tile["boundingVolume"] = {"box": _box(self._bounds[name])}
            if above := name[:-1]:
                theirs = self._bounds[above]
                self._bounds[above] = np.array([np.minimum(low, theirs[0]), np.maximum(high, theirs[1])])
                tiles[above]["geometricError"] = self._errors[above]
                tiles[above].setdefault("children", []).append(tile)
        root = tiles["r"] | {"refine": "ADD"}
        if origin_lla is not None:
            transform = np.eye(4)
            transform[:3, :3] = earth_from_local(origin_lla) @ self._file_from_world.T
            transform[:3, 3] = earth_from_lla(origin_lla)
            root["transform"] = transform.T.ravel().tolist()
        document = {
            "asset": {"version": "1.1", "extras": {"generator": "pano_mvs"}},
            "geometricError": float(np.linalg.norm(np.diff(self._bounds["r"], axis=0))),
            "root": root,
            "extras": about,
        }
        self.files["tileset.json"] = self._folder / "tileset.json"
        self.files["tileset.json"].write_text(json.dumps(document, indent=1), encoding="utf-8")


def _box(bounds: FloatArray) -> list[float]:
    """Return the centre of a box and its three half axes; none has no length, because viewers divide by it."""
    center = bounds.mean(axis=0)
    half = np.maximum((bounds[1] - bounds[0]) / 2, 1e-6 * max(1.0, float(np.abs(bounds).max())))
    return [*center.tolist(), *np.diag(half).ravel().tolist()]


def write_points_glb(path: Path, points: NDArray[np.float32], colors_rgb: NDArray[np.uint8]) -> None:
    """Write points (N, 3) with z up and sRGB colours (N, 3) as a GLB file without lighting."""
    x, y, z = points.T
    positions = np.ascontiguousarray(np.stack([x, z, -y], axis=-1), "<f4")
    encoded = np.arange(256) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    colors = np.full((len(points), 4), 65535, "<u2")
    colors[:, :3] = np.rint(65535 * linear).astype("<u2")[colors_rgb]
    document = unlit_document(
        {"attributes": {"POSITION": 0, "COLOR_0": 1}, "material": 0, "mode": _POINTS},
        {"pbrMetallicRoughness": {"metallicFactor": 0}},
        positions,
        {"componentType": _UINT16, "normalized": True, "count": len(points), "type": "VEC4"},
    )
    views = [{"target": ARRAY_BUFFER}] * 2
    write_glb_parts(path, document, [positions.tobytes(), colors.tobytes()], views=views)
