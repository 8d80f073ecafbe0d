"""Clouds as LAS 1.4 and LAZ."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray
from pano_mvs.api import KeptPoints, PointCloud, UsageError, chunks

from pano_mvs_las.placement import Placement

# Colours and extended returns, no GPS time needed; the least point format of LAS 1.4 with colours.
_POINT_FORMAT = 7
_NORMALS = ("NormalX", "NormalY", "NormalZ")  # as CloudCompare calls them
_MOST_STEPS = 2**31 - 1
_COLOR_16_FROM_8 = 257


def write_las(
    path: Path, cloud: PointCloud, placement: Placement, *, step: float = 0.0001, kept: KeptPoints | None = None
) -> None:
    """Write a cloud as LAS, or as LAZ if the path says so, in chunks.

    16-bit colours; normals (float), views and confidence (8 bits) as extra bytes. The same cloud gives the same bytes:
    no date is written.

    Args:
        path: the file to write.
        cloud: the points.
        placement: where they are.
        step: of the coordinates, in their unit; they are whole numbers of it.
        kept: the points to write; None: all.

    Raises:
        UsageError: if the cloud is too large for steps as small as that.
    """
    low, high = bounds(cloud, placement, kept)
    if (high - low).max() / step > _MOST_STEPS:
        raise UsageError(
            f"a cloud that is {(high - low).max():g} wide does not fit into steps of {step:g}: set `step` "
            f"to {(high - low).max() / _MOST_STEPS:.1g} or more"
        )
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version="1.4")
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32, "surface normal") for name in _NORMALS])
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.uint8) for name in ("views", "confidence")])
    header.scales, header.offsets = np.full(3, step), np.floor(low)
    header.generating_software, header.system_identifier, header.creation_date = "pano_mvs", "", None
    if placement.crs is not None:
        header.add_crs(placement.crs)
    backend = laspy.LazBackend.Lazrs if path.suffix == ".laz" else None
    with laspy.open(path, mode="w", header=header, laz_backend=backend) as writer:
        for chunk in chunks(len(cloud)):
            writer.write_points(_record(header, cloud, chunk, placement, kept))


def bounds(
    cloud: PointCloud, placement: Placement, kept: KeptPoints | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest and the largest coordinates, (3,) each, of the points as written; zeros if there are none."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for chunk in chunks(len(cloud)):
        points = placement.points(cloud.points_in_world[chunk][_within(kept, chunk)])
        if len(points):
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    return (low, high) if np.isfinite(low).all() else (np.zeros(3), np.zeros(3))


def _within(kept: KeptPoints | None, chunk: slice) -> NDArray[np.bool_]:
    return np.ones(chunk.stop - chunk.start, np.bool_) if kept is None else kept.within(chunk)


def _record(
    header: laspy.LasHeader, cloud: PointCloud, chunk: slice, placement: Placement, kept: KeptPoints | None
) -> laspy.ScaleAwarePointRecord:
    wanted = _within(kept, chunk)
    record = laspy.ScaleAwarePointRecord.zeros(int(wanted.sum()), header=header)
    record.x, record.y, record.z = placement.points(cloud.points_in_world[chunk][wanted]).T
    for idx, name in enumerate(("red", "green", "blue")):
        record[name] = cloud.colors_rgb[chunk, idx][wanted].astype(np.uint16) * _COLOR_16_FROM_8
    normals = placement.directions(cloud.normals_in_world[chunk][wanted])
    for idx, name in enumerate(_NORMALS):
        record[name] = normals[:, idx]
    record["views"] = cloud.view_counts[chunk][wanted]
    if cloud.confidence is not None:
        record["confidence"] = cloud.confidence[chunk][wanted]
    record["return_number"][:] = 1
    record["number_of_returns"][:] = 1
    return record
