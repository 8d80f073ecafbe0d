"""Poses from a CSV file, from nerfstudio, and from what is neither."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, quat_wxyz_from_rotation
from pano_mvs.io.poses.files import read_poses
from pano_mvs.scene import Poses
from pano_mvs.testing.room import capture_poses

POSES = dict(zip(("a/1.jpg", "a/2.jpg", "a/10.jpg"), capture_poses(3, seed=5), strict=True))
HEADER = "name,tx,ty,tz,qw,qx,qy,qz"


def same(found: Poses, expected: Mapping[str, Rigid3]) -> None:
    found.check()
    assert found.names == tuple(expected)
    for idx, pose in enumerate(expected.values()):
        assert found.rotations[idx] == pytest.approx(pose.rotation, abs=1e-9)
        assert found.translations[idx] == pytest.approx(pose.translation, abs=1e-9)


def csv_line(name: str, pose: Rigid3, factor: float = 1.0) -> str:
    numbers = [*pose.translation, *(factor * quat_wxyz_from_rotation(pose.rotation))]
    return ",".join([name, *(repr(float(number)) for number in numbers)])


def test_a_csv_file_is_read(tmp_path: Path) -> None:
    lines = [
        "\ufeff# made by hand",
        "",
        HEADER,
        *(csv_line(name, pose, -3.0) for name, pose in POSES.items()),
        "# end",
        " ",
    ]
    (tmp_path / "poses.csv").write_text("\n".join(lines), encoding="utf-8")
    found = read_poses(tmp_path / "poses.csv")
    same(found, POSES)
    assert not found.metric


def test_a_name_with_a_comma_may_be_quoted(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(f'{HEADER}\n"a, b.jpg", 1, 2, 3, 1, 0, 0, 0\n')
    assert read_poses(tmp_path / "poses.csv").names == ("a, b.jpg",)


@pytest.mark.parametrize(
    ("lines", "what"),
    [
        ([], ":1: the first line must be name,tx"),
        (["image,x,y,z"], ":1: the first line must be name,tx"),
        ([HEADER], ": contains no poses"),
        ([HEADER, "", "a,1,2,3"], ":3: expected a name and 7 numbers .* got 4 cells"),
        ([HEADER, "a,1,2,3,1,0,0,zero"], ":2: could not convert"),
        ([HEADER, "# x", "a,1,2,3,0,0,0,0"], ":3: the pose of a .* quaternion of length 0"),
        ([HEADER, "a,nan,2,3,1,0,0,0"], ":2: the pose of a has no finite"),
        ([HEADER, "a,1,2,3,1,0,0,0", "a,1,2,3,1,0,0,0"], ": image 'a' is listed twice"),
    ],
)
def test_a_malformed_csv_is_named_with_its_line(tmp_path: Path, lines: Sequence[str], what: str) -> None:
    (tmp_path / "p.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match=rf"p\.csv{what}"):
        read_poses(tmp_path / "p.csv")


def transforms(**more: object) -> dict[str, object]:
    opengl_from_opencv = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = []
    for name, pose in POSES.items():
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3], world_from_cam[:3, 3] = pose.inverse().rotation, pose.center
        frames.append({"file_path": f"./{name}", "transform_matrix": (world_from_cam @ opengl_from_opencv).tolist()})
    return {"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32, "frames": frames} | more


def test_nerfstudios_transforms_are_read(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps(transforms()))
    same(read_poses(tmp_path / "transforms.json"), POSES)
    same(read_poses(tmp_path), POSES)


def test_opengl_looks_along_minus_z_with_y_up(tmp_path: Path) -> None:
    """The identity of nerfstudio is a camera that looks along −z of the world, which has y up."""
    frames = [{"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(frames=frames)))
    pose = read_poses(tmp_path).cam_from_world(0)
    assert pose.apply((0, 0, -1)) == pytest.approx((0, 0, 1))
    assert pose.apply((0, 1, 0)) == pytest.approx((0, -1, 0))
    assert isinstance(pose, Rigid3)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        ({"frames": {}}, "key 'frames' must be a list"),
        (transforms(camera_model="OPENCV"), r"frames\[0\] \(a/1\.jpg\): camera_model is OPENCV"),
        (transforms(frames=[{"file_path": "a", "transform_matrix": [1]}]), r"frames\[0\]: key 'transform_matrix'"),
        ({"cameras": []}, "neither key 'frames'"),
        ([], "expected a JSON object, got list"),
    ],
)
def test_malformed_transforms_are_named_with_their_key(tmp_path: Path, data: object, what: str) -> None:
    (tmp_path / "t.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=rf"t\.json: {what}"):
        read_poses(tmp_path / "t.json")


def test_what_holds_no_poses_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.json").write_text('{\n "views": [}')
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "poses.txt").touch()
    for name, what in (
        ("broken.json", ":2:12: not JSON"),
        ("binary.json", ": not a text file in UTF-8"),
        ("poses.txt", ": poses are read from"),
        ("gone.csv", ": no such file or folder"),
    ):
        with pytest.raises(InputError, match=name.replace(".", r"\.") + what):
            read_poses(tmp_path / name)
    with pytest.raises(InputError, match="no poses here"):
        read_poses(tmp_path)


IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


def views(**more: object) -> dict[str, object]:
    return {"views": [{"image": "a.png", "R": IDENTITY, "t": [0, 0, 0]}], **more}


def frames(matrix: object) -> dict[str, object]:
    frame = {"file_path": "a.png", "transform_matrix": matrix}
    return {"camera_model": "EQUIRECTANGULAR", "frames": [frame]}


def shots(**part: object) -> list[dict[str, object]]:
    return [{"cameras": {"c": {"projection_type": "spherical"}}, **part}]


SHOT = {"camera": "c", "rotation": [0, 0, 0], "translation": [0, 0, 0]}


@pytest.mark.parametrize(
    ("name", "data", "what"),
    [
        ("poses.json", views(metric="false"), "must be true or false"),
        ("transforms.json", frames([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]), "transposed"),
        ("transforms.json", frames([[1, 0, 0, 10**400], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "4 × 4 numbers"),
        ("transforms.json", frames([[1, 0, 0, 1e308], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "not a valid pos"),
        ("reconstruction.json", shots(shots=3), "must be objects by name"),
        ("reconstruction.json", shots(shots={"a.png": {**SHOT, "camera": ["c"]}}), "projection_type is None"),
    ],
)
def test_traps_are_named(tmp_path: Path, name: str, data: object, what: str) -> None:
    (tmp_path / name).write_text(json.dumps(data))
    with pytest.raises(InputError, match=what) as caught:
        read_poses(tmp_path / name)
    assert name in str(caught.value)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"views": ' + "9" * 5000 + "}"])
def test_json_that_breaks_readers_is_an_input_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "poses.json").write_text(text)
    with pytest.raises(InputError, match=r"poses\.json"):
        read_poses(tmp_path / "poses.json")


def test_a_reconstruction_without_reference_is_not_metric(tmp_path: Path) -> None:
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps(shots(shots={"a.png": SHOT})))
    assert not read_poses(path).metric
