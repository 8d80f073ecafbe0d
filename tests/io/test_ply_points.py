"""PLY files of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.api import Context
from pano_mvs.core.errors import InputError
from pano_mvs.io.ply import open_ply_points, read_ply, read_ply_points, write_ply
from pano_mvs.scene import PointCloud
from pano_mvs.stages.exports.files import PlyParams, ply

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
def test_our_own_files(tmp_path: Path, quality: bool) -> None:
    one = np.ones((2, 3), np.float32)
    cloud = PointCloud(POINTS, one, one.astype(np.uint8), np.array([2, 9], np.uint8), np.array([130, 255], np.uint8))
    write_ply(tmp_path / "a.ply", cloud, quality=quality)
    np.testing.assert_array_equal(read_ply_points(tmp_path / "a.ply"), POINTS)
    back = read_ply(tmp_path / "a.ply")
    back.check()
    np.testing.assert_array_equal(back.points_in_world, POINTS)
    if quality:
        np.testing.assert_array_equal([back.view_counts, back.confidence], [[2, 9], [130, 255]])
    else:
        assert back.confidence is None


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


def test_the_export_writes_quality_on_demand(tmp_path: Path) -> None:
    cloud = PointCloud(
        POINTS, POINTS, POINTS.astype(np.uint8), np.array([2, 9], np.uint8), np.array([130, 255], np.uint8)
    )
    context = Context(np.random.default_rng(0), tmp_path)
    for quality, confidence in ((False, None), (True, [130, 255])):
        files = ply(cloud, None, PlyParams(quality=quality), context)
        back = read_ply(files.files["cloud.ply"])
        assert (None if back.confidence is None else back.confidence.tolist()) == confidence


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
