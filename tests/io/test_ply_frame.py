"""PLY files are turned to z up for other programs; our readers return them to the world of the poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pano_mvs.api import Context, InputError, PointCloud, Poses
from pano_mvs.evaluation.clouds.evaluate import evaluate_cloud
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.io.ply import open_ply_points, read_ply, read_ply_mesh, read_ply_points, write_ply, write_ply_mesh
from pano_mvs.scene.upright import z_up_from_world
from pano_mvs.stages.exports.files import PlyParams, ply
from pano_mvs.viewer.cloud_colors import drawn_cloud

LEVEL = "y down along gravity"


def the_cloud(count: int = 300) -> PointCloud:
    rng = np.random.default_rng(7)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = rng.normal(scale=3, size=(count, 3)).astype(np.float32)
    return PointCloud(points, normals.astype(np.float32), np.zeros((count, 3), np.uint8), np.full(count, 3, np.uint8))


def the_poses(frame: str = LEVEL, rotation: np.ndarray | None = None) -> Poses:
    pose = Rigid3(np.eye(3) if rotation is None else rotation, np.zeros(3))
    return Poses.without_points({"a.png": pose}, frame=frame, scale="", metric=False)


def exported(folder: Path, poses: Poses | None, **settings: object) -> Path:
    params = PlyParams.model_validate(settings)
    return ply(the_cloud(), poses, params, Context(np.random.default_rng(0), folder)).files["cloud.ply"]


def vertices(path: Path) -> np.ndarray:
    """The vertices as another program reads them."""
    loaded: Any = trimesh.load(path)
    return np.asarray(loaded.vertices, np.float32)


def test_other_programs_see_z_up(tmp_path: Path) -> None:
    """trimesh ignores comments, as CloudCompare and MeshLab do."""
    seen = vertices(exported(tmp_path, the_poses()))
    x, y, z = the_cloud().points_in_world.T
    np.testing.assert_array_equal(np.asarray(seen, np.float32), np.stack([x, z, -y], axis=-1))


@pytest.mark.parametrize("poses", [None, the_poses(), the_poses("of a file", rotation_from_rotvec([0.7, 0, 0]))])
def test_our_readers_return_to_the_world(tmp_path: Path, poses: Poses | None) -> None:
    path, cloud = exported(tmp_path, poses), the_cloud()
    file, back = open_ply_points(path), read_ply(path)
    assert file.world_from_file is not None
    drawn = drawn_cloud(file)
    assert drawn.normals is not None
    for points, normals in (
        (back.points_in_world, back.normals_in_world),
        file.some(1),
        (read_ply_points(path), drawn.normals),
        (drawn.points, drawn.normals),
    ):
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
    path = exported(tmp_path, the_poses("of a file", cam_from_world))
    np.testing.assert_array_equal(vertices(path), the_cloud().points_in_world)


def test_a_mesh_returns_to_the_world(tmp_path: Path) -> None:
    corners = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 9]], np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    write_ply_mesh(tmp_path / "m.ply", (corners, np.zeros((3, 3), np.uint8), faces), file_from_world=z_up_from_world())
    np.testing.assert_array_equal(vertices(tmp_path / "m.ply")[0], [0, 2, -1])
    np.testing.assert_array_equal(read_ply_mesh(tmp_path / "m.ply")[0], corners)
    np.testing.assert_array_equal(read_ply_mesh(tmp_path / "m.ply")[2], faces)


def test_scores_of_a_cloud_do_not_depend_on_the_frame_of_the_file(tmp_path: Path) -> None:
    upright = evaluate_cloud(exported(tmp_path, the_poses()), the_cloud().points_in_world)
    assert upright.scores[0].f_score == 1


@pytest.mark.parametrize("numbers", [b"1 0 0 0 1 0 0 0 -1", b"2 0 0 0 2 0 0 0 2", b"1 0 0", b"x", b"nan " * 9])
def test_what_is_not_a_rotation_is_refused(tmp_path: Path, numbers: bytes) -> None:
    write_ply(tmp_path / "a.ply", the_cloud(3), file_from_world=np.eye(3))
    data = (tmp_path / "a.ply").read_bytes()
    before, after = data.split(b"file_from_world 1 0 0 0 1 0 0 0 1\n")
    (tmp_path / "a.ply").write_bytes(before + b"file_from_world " + numbers + b"\n" + after)
    for read in (read_ply, open_ply_points):
        with pytest.raises(InputError, match="file_from_world in its header is not a rotation"):
            read(tmp_path / "a.ply")
