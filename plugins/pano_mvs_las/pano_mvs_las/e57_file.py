"""Clouds and panoramas as E57 (ASTM E2807)."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray
from pano_mvs.api import CHUNK_POINTS, KeptPoints, Panorama, PointCloud, Rigid3, chunks
from pye57 import libe57

from pano_mvs_las.e57_panoramas import CAM_FROM_IMAGE
from pano_mvs_las.las_file import bounds
from pano_mvs_las.placement import Placement

_PLACES = ("cartesianX", "cartesianY", "cartesianZ")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")
_NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
_NAMESPACE = uuid.UUID("6c1f3a52-6d0e-4c43-9d6a-0c5f4a3c8c11")


@dataclass(frozen=True)
class PlacedPanorama:
    """A panorama of the file.

    Attributes:
        name: of its image file.
        panorama: the image, which is loaded when it is written.
        cam_from_world: its pose.
    """

    name: str
    panorama: Panorama
    cam_from_world: Rigid3


def write_e57(
    path: Path,
    cloud: PointCloud,
    placement: Placement,
    *,
    kept: KeptPoints | None = None,
    panoramas: Iterable[PlacedPanorama] = (),
) -> None:
    """Write a cloud as one scan of an E57 file, in chunks: places in double precision, 8-bit colours, normals.

    The same cloud gives the same bytes: no date is written, and its identity follows from its points.

    Panoramas are spherical images (8.4.14 of the standard): the middle of the picture is the positive x axis of the
    image, azimuths grow to the left, elevations upwards. They are JPEG of quality 95 at working resolution, with a mask
    where pixels are masked.

    Args:
        path: the file to write.
        cloud: the points, one at least.
        placement: where they are.
        kept: the points to write; None: all.
        panoramas: images to write with their poses.
    """
    low, high = bounds(cloud, placement, kept)
    count = len(cloud) if kept is None else kept.count
    guid = uuid.uuid5(_NAMESPACE, f"{count} {low.tolist()} {high.tolist()}")
    file = libe57.ImageFile(str(path), "w")
    try:
        _describe_file(file, guid, placement)
        vector = _scan(file, guid, count, low, high)
        _write_points(file, vector, cloud, placement, kept)
        for panorama in panoramas:
            _write_panorama(file, panorama, placement)
    finally:
        file.close()


def _describe_file(file: libe57.ImageFile, guid: uuid.UUID, placement: Placement) -> None:
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    file.extensionsAdd("nor", _NORMALS_URI)
    root = file.root()
    texts = {
        "formatName": "ASTM E57 3D Imaging Data File",
        "guid": f"{{{guid}}}",
        "e57LibraryVersion": libe57.E57_LIBRARY_ID,
        "coordinateMetadata": "" if placement.crs is None else placement.crs.to_wkt(),
    }
    for name, text in texts.items():
        root.set(name, libe57.StringNode(file, text))
    root.set("versionMajor", libe57.IntegerNode(file, libe57.E57_FORMAT_MAJOR))
    root.set("versionMinor", libe57.IntegerNode(file, libe57.E57_FORMAT_MINOR))
    root.set("creationDateTime", _structure(file, {"dateTimeValue": 0.0, "isAtomicClockReferenced": 0}))
    root.set("data3D", libe57.VectorNode(file, True))
    root.set("images2D", libe57.VectorNode(file, True))


def _scan(
    file: libe57.ImageFile, guid: uuid.UUID, count: int, low: NDArray[np.float64], high: NDArray[np.float64]
) -> libe57.CompressedVectorNode:
    scan = libe57.StructureNode(file)
    scan.set("guid", libe57.StringNode(file, f"{{{uuid.uuid5(guid, 'scan')}}}"))
    scan.set("name", libe57.StringNode(file, "pano_mvs"))
    box = {
        f"{axis}{end}": float(value)
        for end, values in (("Minimum", low), ("Maximum", high))
        for axis, value in zip("xyz", values, strict=True)
    }
    scan.set("cartesianBounds", _structure(file, box))
    limits = {f"{name}{end}": value for name in _COLORS for end, value in (("Minimum", 0), ("Maximum", 255))}
    scan.set("colorLimits", _structure(file, limits))
    scan.set("indexBounds", _structure(file, {"rowMinimum": 0, "rowMaximum": max(count - 1, 0)}))
    prototype = libe57.StructureNode(file)
    for name in _PLACES:
        prototype.set(
            name, libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE, libe57.E57_DOUBLE_MIN, libe57.E57_DOUBLE_MAX)
        )
    for name in _COLORS:
        prototype.set(name, libe57.IntegerNode(file, 0, 0, 255))
    for name in _NORMALS:
        prototype.set(name, libe57.FloatNode(file, 0.0, libe57.E57_SINGLE, -1.0, 1.0))
    vector = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    scan.set("points", vector)
    file.root()["data3D"].append(scan)
    return vector


def _write_points(
    file: libe57.ImageFile,
    vector: libe57.CompressedVectorNode,
    cloud: PointCloud,
    placement: Placement,
    kept: KeptPoints | None,
) -> None:
    held = {name: np.empty(CHUNK_POINTS, np.float64) for name in _PLACES}
    held |= {name: np.empty(CHUNK_POINTS, np.uint8) for name in _COLORS}
    held |= {name: np.empty(CHUNK_POINTS, np.float32) for name in _NORMALS}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in held.items():
        buffers.append(libe57.SourceDestBuffer(file, name, array, CHUNK_POINTS, True, True))
    writer = vector.writer(buffers)
    for chunk in chunks(len(cloud)):
        wanted = slice(None) if kept is None else kept.within(chunk)
        points = placement.points(cloud.points_in_world[chunk][wanted])
        normals = np.clip(placement.directions(cloud.normals_in_world[chunk][wanted]), -1, 1)
        colors = cloud.colors_rgb[chunk][wanted]
        for names, values in ((_PLACES, points), (_COLORS, colors), (_NORMALS, normals)):
            for idx, name in enumerate(names):
                held[name][: len(points)] = values[:, idx]
        if len(points):
            writer.write(len(points))
    writer.close()


def _write_panorama(file: libe57.ImageFile, placed: PlacedPanorama, placement: Placement) -> None:
    height, width = placed.panorama.size_hw
    bgr = cv2.cvtColor(placed.panorama.load(), cv2.COLOR_RGB2BGR)
    blobs = {"jpegImage": cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()}
    valid = placed.panorama.load_mask()
    if not valid.all():
        blobs["imageMask"] = cv2.imencode(".png", np.where(valid, 255, 0).astype(np.uint8))[1].tobytes()
    image = libe57.StructureNode(file)
    guid = uuid.uuid5(_NAMESPACE, f"{placed.name} {hashlib.sha256(blobs['jpegImage']).hexdigest()}")
    for name, text in {"guid": f"{{{guid}}}", "name": placed.name, "sensorVendor": "pano_mvs"}.items():
        image.set(name, libe57.StringNode(file, text))
    center = placed.cam_from_world.center
    file_from_image = placement.rotation_at(center) @ placed.cam_from_world.rotation.T @ CAM_FROM_IMAGE
    x, y, z, w = scipy.spatial.transform.Rotation.from_matrix(file_from_image).as_quat().tolist()
    sign = -1.0 if w < 0 else 1.0  # the standard wants w ≥ 0
    pose = libe57.StructureNode(file)
    pose.set("rotation", _structure(file, {"w": sign * w, "x": sign * x, "y": sign * y, "z": sign * z}))
    (place,) = placement.points(center[None])
    pose.set("translation", _structure(file, dict(zip("xyz", place.tolist(), strict=True))))
    image.set("pose", pose)
    sphere = _structure(
        file,
        {
            "imageWidth": width,
            "imageHeight": height,
            "pixelWidth": 2 * np.pi / width,
            "pixelHeight": np.pi / height,
        },
    )
    nodes = {name: libe57.BlobNode(file, len(data)) for name, data in blobs.items()}
    for name, node in nodes.items():
        sphere.set(name, node)
    image.set("sphericalRepresentation", sphere)
    file.root()["images2D"].append(image)
    for name, node in nodes.items():
        node.write(blobs[name], 0, len(blobs[name]))


def _structure(file: libe57.ImageFile, values: Mapping[str, float]) -> libe57.StructureNode:
    node = libe57.StructureNode(file)
    for name, value in values.items():
        node.set(name, (libe57.FloatNode if isinstance(value, float) else libe57.IntegerNode)(file, value))
    return node
