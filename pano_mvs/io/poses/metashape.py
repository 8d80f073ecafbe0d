"""Poses in the XML file that Agisoft Metashape writes with File, Export, Export Cameras, and imports.

A camera's transform is chunk_from_cam by rows, for the camera frame x right, y down, z forward, and that of its
component is x_in_world = s R x_in_chunk + t. A spherical sensor looks along z in the middle of its image, as ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.text import xml_root
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.io.poses.json_files import FilePoses, FoundCamera, rigid_from_arrays
from pano_mvs.scene import FilePart, Poses

_LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'


def read_metashape(path: Path) -> FilePoses:
    """Return the poses of the aligned spherical cameras, by label, in the world of their component.

    Each component is a group of poses. A label that cameras of several groups in Metashape's list have is preceded by
    the label of its group, as by a folder.

    Raises:
        InputError: if the file is not such a file, or no camera is spherical; it names the camera.
    """
    root = _parsed(path)
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None:
        raise InputError(f"{path}: has no element 'chunk'. Export the cameras of Metashape as XML")
    sensors = {sensor.get("id"): sensor.get("type", "frame") for sensor in chunk.iterfind("sensors/sensor")}
    worlds = {component.get("id"): component.find("transform") for component in chunk.iterfind("components/component")}
    found = []
    for name, camera in _aligned(chunk):
        where, component = f"{path}: camera {name!r}", camera.get("component_id")
        world, world_where = worlds.get(component), f"{path}: component {component}"
        pose = partial(_pose, camera, where, component=world, component_where=world_where)
        found.append(FoundCamera(name, where, sensors.get(camera.get("sensor_id")), "spherical", pose, component))
    return FilePoses.of_cameras(found, path)


def _aligned(chunk: ElementTree.Element) -> list[tuple[str, ElementTree.Element]]:
    """Return the names and elements of the enabled cameras that have a pose."""
    found = [("", camera) for camera in chunk.iterfind("cameras/camera")]
    for group in chunk.iterfind("cameras/group"):
        found += [(group.get("label") or "", camera) for camera in group.iterfind(".//camera")]
    aligned = [
        (group, camera.get("label") or "", camera)
        for group, camera in found
        if camera.find("transform") is not None and camera.get("enabled", "true") not in ("false", "0")
    ]
    groups_of = Counter(label for label, _ in {(label, group) for group, label, _ in aligned})
    return [
        (f"{group}/{label}" if groups_of[label] > 1 and group else label, camera) for group, label, camera in aligned
    ]


def _pose(
    camera: ElementTree.Element, where: str, *, component: ElementTree.Element | None, component_where: str
) -> Rigid3:
    matrix = _numbers(camera.findtext("transform"), (4, 4), where)
    chunk_from_cam = rigid_from_arrays(matrix[:3, :3], matrix[:3, 3], where)
    return _similarity(component, component_where).move_camera(chunk_from_cam.inverse())


def _parsed(path: Path) -> ElementTree.Element:
    try:
        return xml_root(FilePart(path).read_bytes())
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: {error}. Export the cameras of Metashape as XML") from error


def _similarity(transform: ElementTree.Element | None, where: str) -> Similarity3:
    if transform is None:
        return Similarity3(1.0, np.eye(3), np.zeros(3))
    parts = {name: transform.findtext(name) for name in ("rotation", "translation", "scale")}
    rotation = np.eye(3) if parts["rotation"] is None else _numbers(parts["rotation"], (3, 3), where)
    translation = np.zeros(3) if parts["translation"] is None else _numbers(parts["translation"], (3,), where)
    scale = 1.0 if parts["scale"] is None else float(_numbers(parts["scale"], (1,), where)[0])
    if not 0 < scale < np.inf:
        raise InputError(f"{where}: its scale {scale} is not a positive number")
    checked = rigid_from_arrays(rotation, translation, where)
    return Similarity3(scale, checked.rotation, checked.translation)


def _numbers(text: str | None, shape: tuple[int, ...], where: str) -> NDArray[np.float64]:
    try:
        found = np.array([float(word) for word in (text or "").split()])
        return found.reshape(shape)
    except ValueError as error:
        raise InputError(f"{where}: expected {' × '.join(map(str, shape))} numbers, got {str(text)[:60]!r}") from error


def write_metashape(
    path: Path, poses: Poses, sizes_hw: Mapping[str, tuple[int, int]], *, file_from_world: NDArray[np.float64]
) -> None:
    """Write poses of one group as cameras of a spherical sensor, in local coordinates.

    Args:
        poses: poses of one group. The chunk has their world.
        sizes_hw: (height, width) of each image.
        file_from_world: (3, 3) rotation of the component, which turns the chunk into the world that Metashape shows.
    """
    document = ElementTree.Element("document", version="2.0.0")
    chunk = ElementTree.SubElement(document, "chunk", label="pano_mvs", enabled="true")
    sizes = list(dict.fromkeys(sizes_hw[name] for name in poses.names))
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(len(sizes)))
    for number, (height, width) in enumerate(sizes):
        sensor = ElementTree.SubElement(sensors, "sensor", id=str(number), label=f"{width}x{height}", type="spherical")
        ElementTree.SubElement(sensor, "resolution", width=str(width), height=str(height))
    components = ElementTree.SubElement(chunk, "components", next_id="1", active_id="0")
    component = ElementTree.SubElement(components, "component", id="0", label="pano_mvs")
    placed = ElementTree.SubElement(component, "transform")
    for name, value in (("rotation", file_from_world), ("translation", np.zeros(3)), ("scale", np.ones(1))):
        ElementTree.SubElement(placed, name, locked="false").text = _text(value)
    cameras = ElementTree.SubElement(chunk, "cameras", next_id=str(len(poses.names)), next_group_id="0")
    for number, name in enumerate(poses.names):
        ids = {"id": str(number), "sensor_id": str(sizes.index(sizes_hw[name])), "component_id": "0"}
        camera = ElementTree.SubElement(cameras, "camera", ids, label=name)
        chunk_from_cam = np.eye(4)
        chunk_from_cam[:3, :3], chunk_from_cam[:3, 3] = poses.rotations[number].T, poses.centers[number]
        ElementTree.SubElement(camera, "transform").text = _text(chunk_from_cam)
    ElementTree.SubElement(chunk, "reference").text = _LOCAL
    ElementTree.indent(document)
    ElementTree.ElementTree(document).write(path, encoding="UTF-8", xml_declaration=True)


def _text(values: NDArray[np.float64]) -> str:
    return " ".join(map(repr, values.ravel().tolist()))
