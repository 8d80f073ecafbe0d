"""Poses of openMVG, AliceVision and Metashape, in their own conventions."""

from __future__ import annotations

import copy
import json
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Similarity3, pixel_from_ray, rotation_from_rotvec, rotvec_from_rotation
from pano_mvs.io.poses.files import read_poses, recorded_pictures
from pano_mvs.io.poses.metashape import write_metashape
from pano_mvs.io.poses.other_json import write_openmvg
from pano_mvs.scene import Poses
from pano_mvs.scene.upright import z_up_from_world
from pano_mvs.testing.room import capture_poses
from pano_mvs.testing.tiny_capture import tiny_capture
from tests.foreign import pip_packages
from tests.oracles.openmvg import SAVED_BY_OPENMVG, SIZES_HW, scene

POSES = dict(zip(("1.jpg", "rooms/2.jpg", "10.jpg"), capture_poses(3, seed=5), strict=True))
SIZE_HW = (512, 1024)
CHUNK = Similarity3(2.5, rotation_from_rotvec(np.array([0.3, -0.2, 0.9])), np.array([10.0, -4.0, 2.0]))


def sfm_data() -> dict[str, Any]:
    """Return a scene as openMVG 2 writes it; the third view has no pose."""

    def wrapped(number: int, data: dict[str, Any], **kind: object) -> dict[str, Any]:
        return {**kind, "ptr_wrapper": {"id": 2147483649 + number, "data": data}}

    views, extrinsics = [], []
    for number, (name, pose) in enumerate(POSES.items()):
        folder, _, file = name.rpartition("/")
        about = {"local_path": folder, "filename": file, "width": SIZE_HW[1], "height": SIZE_HW[0]}
        ids = {"id_view": number, "id_intrinsic": 0, "id_pose": number}
        views.append({"key": number, "value": wrapped(number, about | ids, polymorphic_id=1073741824)})
        extrinsics.append(
            {"key": number, "value": {"rotation": pose.rotation.tolist(), "center": pose.center.tolist()}}
        )
    kind = {"polymorphic_id": 2147483649, "polymorphic_name": "spherical"}
    size = {"value0": {"width": SIZE_HW[1], "height": SIZE_HW[0]}}
    return {
        "sfm_data_version": "0.3",
        "root_path": "/photos",
        "views": views,
        "intrinsics": [{"key": 0, "value": wrapped(9, size, **kind)}],
        "extrinsics": extrinsics[:2],
        "structure": [],
        "control_points": [],
    }


def cameras_xml() -> str:
    """Return an XML file as Metashape writes it; the last camera is not aligned, and a group holds the second."""
    cameras = []
    for number, (name, pose) in enumerate(POSES.items()):
        in_chunk = CHUNK.inverse().move_camera(pose).inverse()
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = in_chunk.rotation, in_chunk.translation
        transform = f"<transform>{' '.join(map(repr, matrix.ravel().tolist()))}</transform>" if number < 2 else ""
        camera = f'<camera id="{number}" sensor_id="0" component_id="0" label="{name}">{transform}</camera>'
        cameras.append(f'<group id="0" label="a">{camera}</group>' if number == 1 else camera)
    placed = {"rotation": CHUNK.rotation.ravel(), "translation": CHUNK.translation, "scale": np.array([CHUNK.scale])}
    world = "".join(
        f'<{name} locked="0">{" ".join(map(repr, part.tolist()))}</{name}>' for name, part in placed.items()
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1" enabled="1">'
        '<sensors next_id="1"><sensor id="0" label="360" type="spherical"><resolution width="1024" height="512"/>'
        "</sensor></sensors>"
        f'<components next_id="1" active_id="0"><component id="0" label="c"><transform>{world}</transform></component>'
        f'</components><cameras next_id="3" next_group_id="1">{"".join(cameras)}</cameras></chunk></document>'
    )


def alicevision() -> dict[str, Any]:
    """Return a scene as AliceVision writes it: numbers as strings, matrices by columns; the third has no pose."""
    views, poses = [], []
    for number, (name, pose) in enumerate(POSES.items()):
        numbers = {"viewId": number, "poseId": number, "intrinsicId": 7, "width": SIZE_HW[1], "height": SIZE_HW[0]}
        views.append({**{key: str(value) for key, value in numbers.items()}, "path": f"/photos/{name}", "metadata": ""})
        transform = {
            "rotation": [repr(value) for value in pose.rotation.T.ravel().tolist()],
            "center": [repr(value) for value in pose.center.tolist()],
        }
        poses.append({"poseId": str(number), "pose": {"transform": transform, "locked": "0"}})
    camera = {"intrinsicId": "7", "width": "1024", "height": "512", "serialNumber": "", "type": "equirectangular"}
    return {"version": ["1", "2", "7"], "views": views, "intrinsics": [camera], "poses": poses[:2]}


FORMS: dict[str, tuple[str, Callable[[], str]]] = {
    "openMVG": ("sfm_data.json", lambda: json.dumps(sfm_data())),
    "AliceVision": ("cameras.sfm", lambda: json.dumps(alicevision())),
    "Metashape": ("cameras.xml", cameras_xml),
}


def written(folder: Path, form: str) -> Path:
    name, text = FORMS[form]
    (folder / name).write_text(text())
    return folder / name


@pytest.mark.parametrize("form", list(FORMS))
def test_aligned_cameras_are_read(tmp_path: Path, form: str) -> None:
    path = written(tmp_path, form)
    found = read_poses(path)
    found.check()
    assert found.names == tuple(POSES)[:2]
    assert not found.metric
    for idx, pose in enumerate(list(POSES.values())[:2]):
        assert found.rotations[idx] == pytest.approx(pose.rotation, abs=1e-9)
        assert found.centers[idx] == pytest.approx(pose.center, abs=1e-9)
    assert recorded_pictures(path) == {}


@pytest.mark.parametrize("form", ["openMVG", "AliceVision"])
def test_a_folder_with_the_scene_is_enough(tmp_path: Path, form: str) -> None:
    written(tmp_path, form)
    assert read_poses(tmp_path).names == tuple(POSES)[:2]


def test_matrices_of_alicevision_are_stored_by_columns(tmp_path: Path) -> None:
    """Pose 1 of scene_v1.2.14.json of AliceVision's tests, which `generateCubeScene` turns by √2 rad about (−1, −1, 0).

    By rows, the rotation would be the opposite one.
    """
    first = "0.57797184738268714 0.42202815261731275 0.69845599863660834"
    second = "0.42202815261731275 0.57797184738268714 -0.69845599863660834"
    third = "-0.69845599863660834 0.69845599863660834 0.15594369476537437"
    data = alicevision()
    data["poses"][0]["pose"]["transform"]["rotation"] = f"{first} {second} {third}".split()
    (tmp_path / "cameras.sfm").write_text(json.dumps(data))
    found = read_poses(tmp_path)
    assert found.rotations[0] == pytest.approx(rotation_from_rotvec(np.array([-1.0, -1.0, 0.0])), abs=1e-9)


def test_pixels_of_openmvg_are_ours() -> None:
    """openMVG: (cos lat sin lon, −sin lat, cos lat cos lon) for u = lon / 2π, v = −lat / 2π in image widths."""
    height, width = SIZE_HW
    pixels = np.random.default_rng(1).uniform((0, 0), (width, height), (200, 2))
    lon, lat = (2 * np.pi * (pixels - (width / 2, height / 2)) / width * (1, -1)).T
    bearings = np.stack([np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)], axis=-1)
    assert pixel_from_ray(bearings, SIZE_HW) == pytest.approx(pixels, abs=1e-9)


@pytest.mark.parametrize("rig", [-1, "-1", "4294967295"])
def test_undefined_rigs_of_alicevision_are_none(tmp_path: Path, rig: object) -> None:
    data = alicevision()
    for view in data["views"]:
        view["rigId"] = rig
    (tmp_path / "cameras.sfm").write_text(json.dumps(data))
    assert len(read_poses(tmp_path / "cameras.sfm").names) == len(data["poses"])


def changed(path: tuple[Any, ...], value: object) -> Callable[[dict[str, Any]], object]:
    def change(data: dict[str, Any]) -> None:
        at: Any = data
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value

    return change


ABOUT = ("views", 0, "value", "ptr_wrapper")


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (changed(("intrinsics", 0, "value", "polymorphic_name"), "pinhole"), "view 0 .* its camera is pinhole"),
        (changed(("views",), {}), "key 'views' must be a list"),
        (changed(("extrinsics", 0, "key"), "a"), "key 'extrinsics' must be a list"),
        (changed(ABOUT, None), "view 0: key 'ptr_wrapper'"),
        (changed((*ABOUT, "data", "filename"), 3), "view 0: key 'filename'"),
        (changed(("extrinsics", 0, "value", "rotation"), [[1]]), "pose 0 .*key 'rotation' must hold 3 × 3"),
        (changed(("extrinsics", 1, "value", "center"), [0, 0, float("nan")]), "pose 1 .*NaN"),
        (changed(("extrinsics",), []), "contains no poses"),
    ],
)
def test_what_is_wrong_in_a_scene_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], what: str
) -> None:
    data = copy.deepcopy(sfm_data())
    change(data)
    (tmp_path / "sfm_data.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=rf"sfm_data\.json: {what}"):
        read_poses(tmp_path)


def without_order(value: Any) -> Any:
    """Return a scene of openMVG without what the order of its hash maps decides: lists by key, no pointer numbers."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return sorted((without_order(item) for item in value), key=lambda item: item["key"])
    if isinstance(value, dict):
        left_out = {"id", "polymorphic_id", "polymorphic_name"}
        return {key: without_order(item) for key, item in value.items() if key not in left_out}
    return value


def test_a_scene_saved_by_openmvg_is_read() -> None:
    """`python -m tests.oracles.openmvg` lets openMVG itself write the file: it names the camera class once."""
    found = read_poses(SAVED_BY_OPENMVG)
    wanted = scene()
    assert set(found.names) == set(wanted.names)
    for name in wanted.names:
        pose = found.cam_from_world(found.names.index(name))
        same = wanted.cam_from_world(wanted.names.index(name))
        assert pose.rotation == pytest.approx(same.rotation, abs=1e-12)
        assert pose.center == pytest.approx(same.center, abs=1e-12)


def without_numbers(file: object) -> tuple[str, list[float]]:
    """Return a file without the order of its lists and without its floating-point numbers, and these by themselves."""
    numbers: list[float] = []
    text = json.dumps(without_order(file))
    return json.dumps(json.loads(text, parse_float=lambda number: numbers.append(float(number)))), numbers


def test_a_scene_for_openmvg_is_as_openmvg_saves_it(tmp_path: Path) -> None:
    """All keys in their order, and all values; openMVG only sorts its lists in another way."""
    write_openmvg(tmp_path / "sfm_data.json", scene(), SIZES_HW)
    data = json.loads((tmp_path / "sfm_data.json").read_text())
    theirs = json.loads(SAVED_BY_OPENMVG.read_text())
    (ours, our_numbers), (saved, saved_numbers) = without_numbers(data), without_numbers(theirs)
    assert ours == saved
    assert our_numbers == pytest.approx(saved_numbers, abs=1e-12)
    for file in (data, theirs):
        kinds = [entry["value"] for entry in file["intrinsics"]]
        assert [kind["polymorphic_id"] for kind in kinds] == [1 << 31 | 1, 1]
        assert [kind.get("polymorphic_name") for kind in kinds] == ["spherical", None]
        assert {entry["value"]["polymorphic_id"] for entry in file["views"]} == {1 << 30}
        wrappers = [entry["value"]["ptr_wrapper"] for part in ("views", "intrinsics") for entry in file[part]]
        assert [wrapper["id"] for wrapper in wrappers] == [1 << 31 | number for number in range(1, 6)]


def test_pixels_in_a_scene_for_openmvg_are_those_of_its_camera(tmp_path: Path) -> None:
    poses = tiny_capture().whole(Poses)
    write_openmvg(tmp_path / "sfm_data.json", poses, dict.fromkeys(poses.names, SIZE_HW))
    data = json.loads((tmp_path / "sfm_data.json").read_text())
    height, width = SIZE_HW
    errors = []
    for landmark in data["structure"]:
        for seen in landmark["value"]["observations"]:
            pose = data["extrinsics"][seen["key"]]["value"]
            x, y, z = np.array(pose["rotation"]) @ (np.array(landmark["value"]["X"]) - pose["center"])
            lon, lat = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
            predicted = np.array([lon, -lat]) / (2 * np.pi) * width + (width / 2, height / 2)
            errors.append(np.abs((predicted - seen["value"]["x"] + width / 2) % width - width / 2))
    assert len(errors) == len(poses.track_point_idx)
    assert np.median(errors) < 0.5


def test_cameras_for_metashape_have_z_up(tmp_path: Path) -> None:
    poses = tiny_capture().whole(Poses)
    sizes = {name: SIZE_HW if idx else (256, 512) for idx, name in enumerate(poses.names)}
    turn = z_up_from_world()
    write_metashape(tmp_path / "cameras.xml", poses, sizes, file_from_world=turn)
    found = read_poses(tmp_path / "cameras.xml")
    assert found.names == poses.names
    assert found.centers == pytest.approx(poses.centers @ turn.T, abs=1e-12)
    assert found.rotations == pytest.approx(poses.rotations @ turn.T, abs=1e-12)
    written_tree, known_tree = (
        ElementTree.parse(tmp_path / "cameras.xml").getroot(),
        ElementTree.fromstring(cameras_xml()),
    )
    known = {element.tag: set(element.keys()) for element in known_tree.iter()}
    for element in written_tree.iter():
        assert set(element.keys()) <= known.get(element.tag, set()) or element.tag == "reference"
    assert [sensor.get("type") for sensor in written_tree.iter("sensor")] == ["spherical"] * 2


@pytest.mark.slow
def test_nerfstudio_reads_the_cameras_for_metashape(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """nerfstudio 1.1.5 (Apache-2.0) converts what Metashape exports; only its reader of this format is installed.

    Its result has cameras by OpenGL's axes, in a world whose axes are turned once more by `applied_transform`.
    """
    poses, turn = tiny_capture().whole(Poses), z_up_from_world()
    write_metashape(tmp_path / "cameras.xml", poses, dict.fromkeys(poses.names, SIZE_HW), file_from_world=turn)
    package = pip_packages(tmp_path / "site", "nerfstudio==1.1.5") / "nerfstudio"
    model = SimpleNamespace(value="EQUIRECTANGULAR")
    imported: dict[str, dict[str, object]] = {
        "open3d": {},
        "nerfstudio.process_data.process_data_utils": {"CAMERA_MODELS": {"equirectangular": model}},
        "nerfstudio.utils.rich_utils": {"CONSOLE": None},
    }
    for name, content in imported.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    reader = runpy.run_path(str(package / "process_data" / "metashape_utils.py"))
    reader["metashape_to_json"]({name: Path(name) for name in poses.names}, tmp_path / "cameras.xml", tmp_path)
    data = json.loads((tmp_path / "transforms.json").read_text())
    assert data["camera_model"] == "EQUIRECTANGULAR"
    assert [frame["file_path"] for frame in data["frames"]] == list(poses.names)
    their_world = np.array(data["applied_transform"])[:, :3]
    for idx, frame in enumerate(data["frames"]):
        assert (frame["h"], frame["w"]) == SIZE_HW
        world_from_gl = np.array(frame["transform_matrix"])
        assert world_from_gl[:3, 3] == pytest.approx(their_world @ turn @ poses.centers[idx], abs=1e-12)
        world_from_cam = their_world @ turn @ poses.rotations[idx].T
        assert world_from_gl[:3, :3] == pytest.approx(world_from_cam * (1, -1, -1), abs=1e-12)


TRANSFORM = ("poses", 0, "pose", "transform")


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (changed(("intrinsics", 0, "type"), "pinhole"), "view 0 .* its camera is pinhole"),
        (changed(("views", 0, "rigId"), "1"), "view 0 .* its camera is part of a rig"),
        (changed(("views",), {}), "key 'views' must be a list"),
        (changed(("views", 0, "path"), "/"), "view 0: key 'path'"),
        (changed(TRANSFORM, [1]), "pose 0 .*must hold a transform"),
        (changed((*TRANSFORM, "rotation"), ["1"]), "pose 0 .*key 'rotation' must hold 9"),
        (changed((*TRANSFORM, "center"), ["0", "0", "nan"]), "pose 0 .*NaN"),
        (changed(("views", 1, "path"), "/photos/1.jpg"), "'/photos/1.jpg' is listed twice"),
        (changed(("poses",), []), "contains no poses"),
    ],
)
def test_what_is_wrong_in_a_scene_of_alicevision_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], what: str
) -> None:
    data = alicevision()
    change(data)
    (tmp_path / "scene.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=rf"scene\.json: .*({what})"):
        read_poses(tmp_path / "scene.json")


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ('type="spherical"', 'type="frame"', "camera '1.jpg': its sensor is frame, expected spherical"),
        ('label="1.jpg"><transform>', 'label="1.jpg"><transform>a ', "expected .* numbers"),
        ("<chunk", "<chunks", "not an XML file"),
        ("</chunk>", "", "not an XML file"),
        ("<document", "<!DOCTYPE x><document", "declares XML entities"),
        ('<scale locked="0">2.5', '<scale locked="0">-1', "its scale -1.0 is not a positive number"),
        ('label="rooms/2.jpg"', 'label="1.jpg"', "'1.jpg' is listed twice"),
    ],
)
def test_what_is_wrong_in_the_xml_is_named(tmp_path: Path, old: str, new: str, what: str) -> None:
    text = cameras_xml()
    assert old in text
    (tmp_path / "cameras.xml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=what):
        read_poses(tmp_path / "cameras.xml")


SHOTS = dict(zip(("1.jpg", "2.jpg", "10.jpg"), capture_poses(3, seed=5), strict=True))


def reconstruction(count: int = 3, **more: Any) -> dict[str, Any]:
    camera = {"projection_type": "spherical", "width": SIZE_HW[1], "height": SIZE_HW[0]}
    shots = {
        name: {
            "rotation": rotvec_from_rotation(pose.rotation).tolist(),
            "translation": pose.translation.tolist(),
            "camera": "v2",
            "gps_position": [0.0, 0.0, 0.0],
        }
        for name, pose in list(SHOTS.items())[:count]
    }
    reference = {"latitude": 52.5, "longitude": 13.4, "altitude": 30.0}
    return {"cameras": {"v2": camera}, "shots": shots, "points": {}, "reference_lla": reference} | more


def reconstruction_file(folder: Path, data: Any) -> Path:
    path = folder / "reconstruction.json"
    path.write_text(json.dumps(data))
    return path


def test_the_largest_reconstruction_is_read(tmp_path: Path) -> None:
    reconstruction_file(tmp_path, [reconstruction(1), reconstruction(3)])
    found = read_poses(tmp_path)
    found.check()
    assert found.names == tuple(SHOTS)
    assert found.metric
    assert "metres" in found.scale
    for idx, pose in enumerate(SHOTS.values()):
        assert found.rotations[idx] == pytest.approx(pose.rotation, abs=1e-9)
        assert found.translations[idx] == pytest.approx(pose.translation, abs=1e-12)


def test_without_gps_the_unit_means_nothing(tmp_path: Path) -> None:
    reference = {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    assert not read_poses(reconstruction_file(tmp_path, [reconstruction(reference_lla=reference)])).metric


def test_its_pixels_are_ours(tmp_path: Path) -> None:
    """OpenSfM: bearing (cos lat sin lon, −sin lat, cos lat cos lon), u = lon / 2π, v = −lat / 2π, in picture widths
    from the picture's middle."""
    pose = read_poses(reconstruction_file(tmp_path, [reconstruction()])).cam_from_world(1)
    x, y, z = pose.apply((0.3, -0.8, 1.7))
    longitude, latitude = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    u, v = longitude / (2 * np.pi), -latitude / (2 * np.pi)
    height, width = SIZE_HW
    expected = (width / 2 + u * width, height / 2 + v * width)
    assert pixel_from_ray((x, y, z), SIZE_HW) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("part", "what"),
    [
        (reconstruction(cameras={"v2": {"projection_type": "perspective"}}), "shot '1.jpg'.*perspective, expected"),
        (reconstruction(cameras={}), "projection_type is None"),
        (reconstruction(cameras=[]), "must be objects"),
        (reconstruction(shots={}), "contains no poses"),
        (reconstruction(shots={"a": 1}), "shot 'a': expected an object"),
        (reconstruction(shots={"a": {"camera": "v2", "rotation": [0, 0]}}), "key 'rotation' must hold 3 numbers"),
        (
            reconstruction(shots={"a": {"camera": "v2", "rotation": [0, 0, float("nan")], "translation": [0, 0, 0]}}),
            "key 'rotation' holds NaN",
        ),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, part: dict[str, Any], what: str) -> None:
    with pytest.raises(InputError, match=rf"reconstruction\.json: .*{what}"):
        read_poses(reconstruction_file(tmp_path, [part]))


@pytest.mark.parametrize("folder", ["//host/share/photos/", "\\\\host\\share\\photos\\", "C:\\photos\\", "/", ""])
def test_images_of_alicevision_lie_anywhere(tmp_path: Path, folder: str) -> None:
    """Paths on a network share ended with a traceback."""
    data = alicevision()
    for view in data["views"]:
        view["path"] = folder + view["path"].removeprefix("/photos/")
    (tmp_path / "cameras.sfm").write_text(json.dumps(data))
    assert read_poses(tmp_path).names == tuple(POSES)[:2]
