"""Poses of all programs in their own conventions, and what is wrong in their files."""

from __future__ import annotations

import json
import re
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
from pano_mvs.geometry import (
    Similarity3,
    pixel_from_ray,
    quat_wxyz_from_rotation,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from pano_mvs.io.poses.files import read_groups, read_poses, recorded_pictures
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
HEADER = "name,tx,ty,tz,qw,qx,qy,qz"
REFERENCE = {"latitude": 52.5, "longitude": 13.4, "altitude": 30.0}


def csv_text() -> str:
    lines = ["\ufeff# made by hand", "", HEADER]
    for name, pose in POSES.items():
        numbers = [*pose.translation, *(-3.0 * quat_wxyz_from_rotation(pose.rotation))]  # of any length
        lines.append(",".join([name, *(repr(float(number)) for number in numbers)]))
    return "\n".join([*lines, "# end", " "])


def transforms() -> dict[str, Any]:
    frames = []
    for name, pose in POSES.items():
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3], world_from_cam[:3, 3] = pose.inverse().rotation * (1, -1, -1), pose.center
        frames.append({"file_path": f"./{name}", "transform_matrix": world_from_cam.tolist()})
    return {"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32, "frames": frames}


def reconstructions() -> list[dict[str, Any]]:
    """Return what OpenSfM writes: a reconstruction of one image, and a larger one."""
    camera = {"projection_type": "spherical", "width": SIZE_HW[1], "height": SIZE_HW[0]}
    shots = {
        name: {
            "rotation": rotvec_from_rotation(pose.rotation).tolist(),
            "translation": pose.translation.tolist(),
            "camera": "v2",
            "gps_position": [0.0, 0.0, 0.0],
        }
        for name, pose in POSES.items()
    }
    whole = {"cameras": {"v2": camera}, "shots": shots, "points": {}, "reference_lla": REFERENCE}
    return [whole | {"shots": {"1.jpg": shots["1.jpg"]}}, whole]


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


FORMS: dict[str, tuple[str, Callable[[], Any], int]] = {
    "CSV": ("poses.csv", csv_text, 3),
    "nerfstudio": ("transforms.json", transforms, 3),
    "openMVG": ("sfm_data.json", sfm_data, 2),
    "AliceVision": ("cameras.sfm", alicevision, 2),
    "OpenSfM": ("reconstruction.json", reconstructions, 3),
    "Metashape": ("cameras.xml", cameras_xml, 2),
}
"""File, content, and number of poses."""


def written(folder: Path, form: str, at: str | tuple[Any, ...] = (None,), value: Any = None) -> Path:
    """Write a file of a form: with a part of its text replaced, or with a value of its JSON; `()` is all of it."""
    name, content, _ = FORMS[form]
    return changed(folder / name, value if at == () else content(), at, value)


def changed(path: Path, data: Any, at: str | tuple[Any, ...], value: Any) -> Path:
    """Write a file with a part of its text replaced, or with a value of its JSON."""
    if isinstance(at, str):
        assert at in data
        data = data.replace(at, value, 1)
    elif at not in {(), (None,)}:
        *above, last = at
        part = data
        for key in above:
            part = part[key]
        part[last] = value
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    return path


@pytest.mark.parametrize("form", FORMS)
def test_aligned_cameras_are_read(tmp_path: Path, form: str) -> None:
    """From the file, and from its folder if its name says what it is."""
    path, count = written(tmp_path, form), FORMS[form][2]
    for given in [path] if form in {"CSV", "Metashape"} else [path, tmp_path]:
        found = read_poses(given)
        found.check()
        assert found.names == tuple(POSES)[:count]
        for idx, pose in enumerate(list(POSES.values())[:count]):
            assert found.rotations[idx] == pytest.approx(pose.rotation, abs=1e-9)
            assert found.translations[idx] == pytest.approx(pose.translation, abs=1e-9)
        assert found.metric == (form == "OpenSfM")
    assert recorded_pictures(path) == {}


def test_a_name_with_a_comma_may_be_quoted(tmp_path: Path) -> None:
    assert read_poses(written(tmp_path, "CSV", (), f'{HEADER}\n"a, b.jpg", 1, 2, 3, 1, 0, 0, 0\n')).names == (
        "a, b.jpg",
    )


def test_opengl_looks_along_minus_z_with_y_up(tmp_path: Path) -> None:
    """The identity of nerfstudio is a camera that looks along −z of the world, which has y up."""
    pose = read_poses(
        written(tmp_path, "nerfstudio", ("frames", 0, "transform_matrix"), np.eye(4).tolist())
    ).cam_from_world(0)
    assert pose.apply((0, 0, -1)) == pytest.approx((0, 0, 1))
    assert pose.apply((0, 1, 0)) == pytest.approx((0, -1, 0))


@pytest.mark.parametrize("reference", [None, {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}])
def test_without_gps_the_unit_means_nothing(tmp_path: Path, reference: object) -> None:
    assert not read_poses(written(tmp_path, "OpenSfM", (1, "reference_lla"), reference)).metric


def test_matrices_of_alicevision_are_stored_by_columns(tmp_path: Path) -> None:
    """Pose 1 of scene_v1.2.14.json of AliceVision's tests, which `generateCubeScene` turns by √2 rad about (−1, −1, 0).

    By rows, the rotation would be the opposite one.
    """
    first = "0.57797184738268714 0.42202815261731275 0.69845599863660834"
    second = "0.42202815261731275 0.57797184738268714 -0.69845599863660834"
    third = "-0.69845599863660834 0.69845599863660834 0.15594369476537437"
    found = read_poses(written(tmp_path, "AliceVision", (*TRANSFORM, "rotation"), f"{first} {second} {third}".split()))
    assert found.rotations[0] == pytest.approx(rotation_from_rotvec(np.array([-1.0, -1.0, 0.0])), abs=1e-9)


def test_pixels_of_openmvg_and_opensfm_are_ours() -> None:
    """Both: (cos lat sin lon, −sin lat, cos lat cos lon) for u = lon / 2π, v = −lat / 2π in image widths."""
    height, width = SIZE_HW
    pixels = np.random.default_rng(1).uniform((0, 0), (width, height), (200, 2))
    lon, lat = (2 * np.pi * (pixels - (width / 2, height / 2)) / width * (1, -1)).T
    bearings = np.stack([np.cos(lat) * np.sin(lon), -np.sin(lat), np.cos(lat) * np.cos(lon)], axis=-1)
    assert pixel_from_ray(bearings, SIZE_HW) == pytest.approx(pixels, abs=1e-9)


@pytest.mark.parametrize("rig", [-1, "-1", "4294967295"])
def test_undefined_rigs_of_alicevision_are_none(tmp_path: Path, rig: object) -> None:
    views = [view | {"rigId": rig} for view in alicevision()["views"]]
    assert len(read_poses(written(tmp_path, "AliceVision", ("views",), views)).names) == 2


@pytest.mark.parametrize("folder", ["//host/share/photos/", "\\\\host\\share\\photos\\", "C:\\photos\\", "/", ""])
def test_images_of_alicevision_lie_anywhere(tmp_path: Path, folder: str) -> None:
    """Paths on a network share ended with a traceback."""
    views = [view | {"path": folder + view["path"].removeprefix("/photos/")} for view in alicevision()["views"]]
    assert read_poses(written(tmp_path, "AliceVision", ("views",), views)).names == tuple(POSES)[:2]


ABOUT = ("views", 0, "value", "ptr_wrapper")
TRANSFORM = ("poses", 0, "pose", "transform")
MATRIX = ("frames", 0, "transform_matrix")
SHOT = (1, "shots", "1.jpg")
VIEW = {"image": "1.jpg", "R": np.eye(3).tolist(), "t": [0, 0, 0]}


def matrix(x: float, last: tuple[int, ...] = (0, 0, 0, 1)) -> list[Any]:
    return [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], last]


@pytest.mark.parametrize(
    ("form", "at", "value", "what"),
    [
        ("CSV", (), "", ":1: the first line must be name,tx"),
        ("CSV", HEADER, "image,a,b,c", ":3: the first line must be name,tx"),
        ("CSV", (), HEADER, ": contains no poses"),
        ("CSV", (), f"{HEADER}\n\na,1,2,3", ":3: expected a name and 7 numbers .* got 4 cells"),
        ("CSV", (), f"{HEADER}\na,1,2,3,1,0,0,zero", ":2: could not convert"),
        ("CSV", (), f"{HEADER}\n# x\na,1,2,3,0,0,0,0", ":3: the pose of a .* quaternion of length 0"),
        ("CSV", (), f"{HEADER}\na,nan,2,3,1,0,0,0", ":2: the pose of a has no finite"),
        ("CSV", "10.jpg", "1.jpg", ": image '1.jpg' is listed twice"),
        ("nerfstudio", ("frames",), {}, ": key 'frames' must be a list"),
        ("nerfstudio", ("camera_model",), "OPENCV", r": frames\[0\] \(1\.jpg\): its camera is OPENCV"),
        ("nerfstudio", MATRIX, [1], r": frames\[0\] \(1\.jpg\): key 'transform_matrix'"),
        ("nerfstudio", MATRIX, matrix(0, (1, 2, 3, 1)), ": .*transposed"),
        ("nerfstudio", MATRIX, matrix(10**400), ": .*4 × 4 numbers"),
        ("nerfstudio", MATRIX, matrix(float("nan")), r": frames\[0\] \(1\.jpg\): the pose holds NaN"),
        ("nerfstudio", MATRIX, matrix(1e308), ": .*not a valid pos"),
        ("nerfstudio", (), {"cameras": []}, ": neither key 'frames'"),
        ("nerfstudio", (), [1], ": expected a JSON object, got list"),
        ("OpenSfM", (), [], ": an empty list of reconstructions: OpenSfM reconstructed nothing"),
        ("nerfstudio", (), {"metric": "false", "views": [VIEW]}, ": .*must be true or false"),
        ("nerfstudio", (), '{\n "views": [}', ":2:12: not JSON"),
        ("nerfstudio", (), "[" * 100_000, ""),
        ("nerfstudio", (), '{"views": ' + "9" * 5000 + "}", ""),
        ("openMVG", ("intrinsics", 0, "value", "polymorphic_name"), "pinhole", ": view 0 .* its camera is pinhole"),
        ("openMVG", ("views",), {}, ": key 'views' must be a list"),
        ("openMVG", ("extrinsics", 0, "key"), "a", ": key 'extrinsics' must be a list"),
        ("openMVG", ABOUT, None, ": view 0: key 'ptr_wrapper'"),
        ("openMVG", (*ABOUT, "data", "filename"), 3, ": view 0: key 'filename'"),
        ("openMVG", ("extrinsics", 0, "value", "rotation"), [[1e200] * 3] * 3, ": pose 0 .* not orthonormal"),
        ("openMVG", ("extrinsics", 0, "value", "rotation"), [[1]], ": pose 0 .*key 'rotation' must hold 3 × 3"),
        ("openMVG", ("extrinsics", 1, "value", "center"), [0, 0, float("nan")], ": pose 1 .*NaN"),
        ("openMVG", ("extrinsics",), [], ": contains no poses"),
        ("AliceVision", ("intrinsics", 0, "type"), "pinhole", ": view 0 .* its camera is pinhole"),
        ("AliceVision", ("poses",), [{"poseId": []}], ": contains no poses"),
        ("AliceVision", ("views",), {}, ": key 'views' must be a list"),
        ("AliceVision", ("views", 0, "path"), "/", ": view 0: key 'path'"),
        ("AliceVision", TRANSFORM, [1], ": pose 0 .*must hold a transform"),
        ("AliceVision", (*TRANSFORM, "rotation"), ["1"], ": pose 0 .*key 'rotation' must hold 9"),
        ("AliceVision", (*TRANSFORM, "center"), ["0", "0", "nan"], ": pose 0 .*NaN"),
        ("AliceVision", ("views", 1, "path"), "/photos/1.jpg", ": .*'/photos/1.jpg' is listed twice"),
        ("AliceVision", ("poses",), [], ": contains no poses"),
        ("OpenSfM", (1, "cameras"), [], ": .*must be objects by name"),
        ("OpenSfM", (0, "shots"), 3, ": .*must be objects by name"),
        ("OpenSfM", (), [{"cameras": {}, "shots": {}}], ": contains no poses"),
        ("OpenSfM", SHOT, 1, ": shot '1.jpg': expected an object"),
        ("OpenSfM", (*SHOT, "rotation"), [0, 0], ": .*key 'rotation' must hold 3 numbers"),
        ("OpenSfM", (*SHOT, "rotation"), [0, 0, float("nan")], ": .*key 'rotation' holds NaN"),
        ("Metashape", 'type="spherical"', 'type="frame"', ": camera '1.jpg': its camera is frame, expected spherical"),
        ("Metashape", 'label="1.jpg"><transform>', 'label="1.jpg"><transform>a ', ": .*expected .* numbers"),
        ("Metashape", "<chunk", "<chunks", ": .*not an XML file"),
        ("Metashape", "</chunk>", "", ".*not an XML file"),
        ("Metashape", "<document", "<!DOCTYPE x><document", ": .*declares XML entities"),
        ("Metashape", '<scale locked="0">2.5', '<scale locked="0">-1', ": .*its scale -1.0 is not a positive number"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(
    tmp_path: Path, form: str, at: str | tuple[Any, ...], value: object, what: str
) -> None:
    path = written(tmp_path, form, at, value)
    with pytest.raises(InputError, match=re.escape(path.name) + what):
        read_poses(path)


@pytest.mark.parametrize(
    ("form", "at", "value", "name", "why"),
    [
        (
            "nerfstudio",
            ("frames", 0, "camera_model"),
            "OPENCV",
            "1.jpg",
            "its camera is OPENCV, expected EQUIRECTANGULAR",
        ),
        ("openMVG", (*ABOUT, "data", "id_intrinsic"), 1, "1.jpg", "its camera is pinhole, expected spherical"),
        ("openMVG", (*ABOUT, "data", "id_intrinsic"), [], "1.jpg", "its camera is not in the file"),
        ("AliceVision", ("views", 0, "intrinsicId"), {}, "/photos/1.jpg", "its camera is not in the file"),
        ("AliceVision", ("views", 0, "rigId"), "1", "/photos/1.jpg", "its camera is part of a rig"),
        ("OpenSfM", (*SHOT, "camera"), "phone", "1.jpg", "its camera is perspective, expected spherical"),
        ("Metashape", '"0" sensor_id="0"', '"0" sensor_id="1"', "1.jpg", "its camera is frame, expected spherical"),
    ],
)
def test_photographs_among_panoramas_are_named(
    tmp_path: Path, form: str, at: str | tuple[Any, ...], value: object, name: str, why: str
) -> None:
    """One picture of a phone made the whole file unusable."""
    file, content, count = FORMS[form]
    data = content()
    if form == "openMVG":
        data["intrinsics"].append({"key": 1, "value": {"polymorphic_id": 1 << 31 | 2, "polymorphic_name": "pinhole"}})
    elif form == "OpenSfM":
        data = data[1:]
        data[0]["cameras"]["phone"] = {"projection_type": "perspective"}
        at = (0, *at[1:])
    elif form == "Metashape":
        data = data.replace("</sensors>", '<sensor id="1" label="phone" type="frame"/></sensors>')
    path = changed(tmp_path / file, data, at, value)
    found = read_poses(path)
    assert [Path(other).name for other in found.names] == ["2.jpg", "10.jpg"][: count - 1]
    assert list(found.rejected) == [name]
    assert found.rejected[name].startswith(why)


def test_several_reconstructions_are_groups(tmp_path: Path) -> None:
    whole = reconstructions()[1]
    shots = whole["shots"]
    second = whole | {"shots": {"other/4.jpg": shots["10.jpg"], "1.jpg": shots["1.jpg"]}}
    path = written(tmp_path, "OpenSfM", (), [second, whole, whole | {"shots": {}}])
    first, other = read_groups(path)
    assert (first.names, other.names) == (tuple(POSES), ("other/4.jpg",))
    assert other.rotations[0] == pytest.approx(POSES["10.jpg"].rotation, abs=1e-9)
    assert first.frame != other.frame


def test_labels_that_repeat_are_told_apart_by_their_groups(tmp_path: Path) -> None:
    """The same label in two groups of Metashape's list made the file unusable."""
    found = read_poses(written(tmp_path, "Metashape", 'label="rooms/2.jpg"', 'label="1.jpg"'))
    assert found.names == ("1.jpg", "a/1.jpg")
    alike = cameras_xml().replace('label="rooms/2.jpg"', 'label="1.jpg"').replace('<group id="0" label="a">', "<group>")
    with pytest.raises(InputError, match=r"cameras\.xml: image '1\.jpg' is listed twice"):
        read_poses(written(tmp_path, "Metashape", (), alike))


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("binary.json", r"binary\.json: not a text file in UTF-8"),
        ("poses.doc", r"poses\.doc: poses are read from"),
        ("gone.csv", r"gone\.csv: no such file or folder"),
        ("", "no poses here"),
    ],
)
def test_what_holds_no_poses_is_named(tmp_path: Path, name: str, what: str) -> None:
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "poses.doc").touch()
    with pytest.raises(InputError, match=what):
        read_poses(tmp_path / name)


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
