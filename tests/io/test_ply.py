"""PLY files of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pano_mvs.api import Context, InputError, PointCloud, Poses, WorldAxes
from pano_mvs.geometry import rotation_from_rotvec
from pano_mvs.io.ply import RGB, open_ply_points, read_ply, read_ply_mesh, read_ply_points, write_ply, write_ply_mesh
from pano_mvs.scene.upright import z_up_from_world
from pano_mvs.stages.exports.files import PlyParams, ply
from tests.synthetic.exported_clouds import exported, the_cloud, the_poses

POINTS = np.array([[1, 2, 3], [-4.5, 0.25, 1e6]], np.float32)


def header(form: str, properties: Sequence[str], count: int | str = 2, more: Sequence[str] = ()) -> bytes:
    lines = ["ply", f"format {form} 1.0", "comment of element vertex 7", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property {text}" for text in properties), *more, "end_header", ""]).encode()


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_files_of_either_order_with_other_properties_and_faces(tmp_path: Path, form: str, order: str) -> None:
    layout = [("confidence", f"{order}f4"), ("z", f"{order}f8"), ("x", f"{order}f4"), ("id", "u1"), ("y", f"{order}f4")]
    vertices = np.zeros(2, layout)
    for idx, name in enumerate("xyz"):
        vertices[name] = POINTS[:, idx]
    properties = ["float32 confidence", "double z", "float x", "uchar id", "float y"]
    faces = ["element face 1", "property list uchar int vertex_indices"]
    path = tmp_path / "a.ply"
    path.write_bytes(header(form, properties, more=faces) + vertices.tobytes() + b"\3" + bytes(12))
    np.testing.assert_array_equal(read_ply_points(path), POINTS)


def test_text_files(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(header("ascii", ["float x", "float y", "float z", "uchar red"]) + b"1 2 3 9\n-4.5 0.25 1e6 8\n")
    np.testing.assert_array_equal(read_ply_points(path), POINTS)
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    np.testing.assert_array_equal(read_ply_points(path), POINTS)


@pytest.mark.parametrize("quality", [False, True])
@pytest.mark.parametrize("uncertainty", [False, True])
def test_our_own_files_hold_what_is_asked_for(tmp_path: Path, quality: bool, uncertainty: bool) -> None:
    ones, sigmas = np.ones((2, 3), np.float32), np.array([0.01, 0.5], np.float32)
    counts, confidence = np.array([2, 9], np.uint8), np.array([130, 255], np.uint8)
    cloud = PointCloud(POINTS, ones, ones.astype(np.uint8), counts, confidence, uncertainty=sigmas)
    params = PlyParams(quality=quality, uncertainty=uncertainty)
    path = ply(cloud, None, params, Context(np.random.default_rng(0), tmp_path)).files["cloud.ply"]
    head, _, body = path.read_bytes().partition(b"end_header\n")
    names = [*(f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")), *(f"uchar {name}" for name in RGB)]
    names += ["uchar views", "uchar confidence"] * quality + ["float uncertainty"] * uncertainty
    lines = [line for line in head.decode().splitlines() if not line.startswith("comment")]
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    assert lines[3:] == [f"property {name}" for name in names]
    assert len(body) == 2 * (27 + 2 * quality + 4 * uncertainty)
    back = read_ply(path)
    back.check()
    np.testing.assert_array_equal(back.points_in_world, POINTS)
    np.testing.assert_array_equal(back.view_counts, counts if quality else 0)
    np.testing.assert_array_equal(back.confidence, confidence if quality else None)
    np.testing.assert_array_equal(back.uncertainty, sigmas if uncertainty else None)
    write_ply(path, replace(cloud, uncertainty=None), quality=quality, uncertainty=uncertainty)
    assert read_ply(path).uncertainty is None


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"", "no end_header"),
        (header("ascii", ["float x", "float y"]) + b"1 2\n3 4\n", "lack x, y or z"),
        (header("ascii", ["float x", "float y", "float z"]) + b"1 2 3\n", "states 2 points"),
        (header("ascii", ["float x", "float y", "float z"]) + b"1 2 3\n4 5\n", "states 2 points"),
        (header("ascii", ["float x", "float y", "float z"]) + b"1 2 3\n4 5 nan\n", "no finite position"),
        (header("binary_little_endian", ["float x", "float y", "float z"]) + bytes(23), "states 2 points"),
        (header("binary_middle_endian", ["float x", "float y", "float z"]), "no known format"),
        (header("ascii", ["list uchar int x", "float y", "float z"]), "lists or properties of unknown types"),
        (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "must be its vertices"),
        (header("ascii", ["float x"], "9" * 5000), "must be its vertices with their number"),
        (header("binary_little_endian", ["float x", "float y", "float z"], 10**15), "states 10+ points"),
        (header("ascii", ["float x", "float x", "float y", "float z"]), "or have a property twice"),
    ],
)
def test_damaged_and_strange_files_are_named(tmp_path: Path, data: bytes, what: str) -> None:
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.ply: .*{what}"):
        read_ply_points(tmp_path / "a.ply")
    with pytest.raises(InputError, match="cannot be read"):
        read_ply_points(tmp_path / "no.ply")


def test_a_file_is_read_in_parts_with_its_normals(tmp_path: Path) -> None:
    """Nothing but the part that is asked for comes into memory."""
    points = np.random.default_rng(0).normal(size=(11, 3)).astype(np.float32)
    normals = np.tile(np.array([0, 0, -1], np.float32), (11, 1))
    write_ply(tmp_path / "a.ply", PointCloud(points, normals, np.zeros((11, 3), np.uint8), np.ones(11, np.uint8)))
    file = open_ply_points(tmp_path / "a.ply")
    assert (file.count, file.has_normals) == (11, True)
    assert isinstance(file.vertices, np.memmap)
    assert [len(chunk) for chunk in file.chunks(4)] == [4, 4, 3]
    np.testing.assert_array_equal(np.concatenate(list(file.chunks(4))), points)
    some, towards = file.some(3)
    np.testing.assert_array_equal(some, points[::3])
    np.testing.assert_array_equal(towards, normals[::3])
    (tmp_path / "b.ply").write_bytes(header("ascii", ["float x", "float y", "float z"], 1) + b"1 2 3\n")
    np.testing.assert_array_equal(open_ply_points(tmp_path / "b.ply").some(1)[1], [[0, 0, 0]])
    (tmp_path / "c.ply").write_bytes(header("binary_little_endian", ["float x", "float y", "float z"], 0))
    assert list(open_ply_points(tmp_path / "c.ply").chunks()) == []


def vertices(path: Path) -> np.ndarray:
    """The vertices as another program reads them."""
    loaded: Any = trimesh.load(path)
    return np.asarray(loaded.vertices, np.float32)


def test_other_programs_see_z_up(tmp_path: Path) -> None:
    """trimesh ignores comments, as CloudCompare and MeshLab do."""
    seen = vertices(exported(tmp_path, the_poses()))
    x, y, z = the_cloud().points_in_world.T
    np.testing.assert_array_equal(np.asarray(seen, np.float32), np.stack([x, z, -y], axis=-1))


@pytest.mark.parametrize("poses", [None, the_poses(), the_poses(WorldAxes.UNKNOWN, rotation_from_rotvec([0.7, 0, 0]))])
def test_our_readers_return_to_the_world(tmp_path: Path, poses: Poses | None) -> None:
    path, cloud = exported(tmp_path, poses), the_cloud()
    file, back = open_ply_points(path), read_ply(path)
    assert file.world_from_file is not None
    np.testing.assert_allclose(read_ply_points(path), cloud.points_in_world, rtol=0, atol=2e-6)
    for points, normals in ((back.points_in_world, back.normals_in_world), file.some(1)):
        np.testing.assert_allclose(points, cloud.points_in_world, rtol=0, atol=2e-6)
        np.testing.assert_allclose(normals, cloud.normals_in_world, rtol=0, atol=1e-6)


def test_an_exchange_of_axes_keeps_every_bit(tmp_path: Path) -> None:
    back = read_ply(exported(tmp_path, the_poses()))
    np.testing.assert_array_equal(back.points_in_world, the_cloud().points_in_world)


def test_the_world_frame_can_be_kept_without_a_comment(tmp_path: Path) -> None:
    path = exported(tmp_path, the_poses(), frame="world")
    assert b"comment" not in path.read_bytes().partition(b"end_header")[0]
    np.testing.assert_array_equal(vertices(path), the_cloud().points_in_world)


def test_a_world_that_has_z_up_already_is_not_turned(tmp_path: Path) -> None:
    """Such as a COLMAP model that was aligned to a map: y of the camera is down, −z of the world."""
    cam_from_world = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    path = exported(tmp_path, the_poses(WorldAxes.UNKNOWN, cam_from_world))
    np.testing.assert_array_equal(vertices(path), the_cloud().points_in_world)


def test_a_mesh_returns_to_the_world(tmp_path: Path) -> None:
    corners = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 9]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    write_ply_mesh(tmp_path / "m.ply", (corners, np.zeros((3, 3), np.uint8), faces), file_from_world=z_up_from_world())
    np.testing.assert_array_equal(vertices(tmp_path / "m.ply")[0], [0, 2, -1])
    np.testing.assert_array_equal(read_ply_mesh(tmp_path / "m.ply")[0], corners)
    np.testing.assert_array_equal(read_ply_mesh(tmp_path / "m.ply")[2], faces)


@pytest.mark.parametrize("numbers", [b"1 0 0 0 1 0 0 0 -1", b"2 0 0 0 2 0 0 0 2", b"1 0 0", b"x", b"nan " * 9])
def test_what_is_not_a_rotation_is_refused(tmp_path: Path, numbers: bytes) -> None:
    write_ply(tmp_path / "a.ply", the_cloud(3), file_from_world=np.eye(3))
    data = (tmp_path / "a.ply").read_bytes()
    before, after = data.split(b"file_from_world 1 0 0 0 1 0 0 0 1\n")
    (tmp_path / "a.ply").write_bytes(before + b"file_from_world " + numbers + b"\n" + after)
    for read in (read_ply, open_ply_points):
        with pytest.raises(InputError, match="file_from_world in its header is not a rotation"):
            read(tmp_path / "a.ply")
