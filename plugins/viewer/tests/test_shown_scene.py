from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.recfunctions import drop_fields
from pano_mvs_viewer.actors import LARGE_WIDTH, SMALL_WIDTH, sphere_picture
from pano_mvs_viewer.cloud_colors import DrawnCloud, color_cloud, drawn_cloud
from pano_mvs_viewer.shown_scene import has_faces, open_scene

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.io.images.preview import write_preview
from pano_mvs.io.ply import open_ply_points, write_ply
from pano_mvs.scene import PointCloud
from pano_mvs.scene.image_file import decode_image
from tests.synthetic.viewed_scenes import turned_poses, write_output

UP = np.array([0.0, -1, 0])
MESH = """\
ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""


def test_an_output_folder_is_opened_with_all_that_it_holds(tmp_path: Path) -> None:
    poses = turned_poses(3)
    out = write_output(tmp_path, poses)
    scene = open_scene(out)
    assert [camera.name for camera in scene.cameras] == list(poses)
    for camera in scene.cameras:
        np.testing.assert_allclose(camera.cam_from_world.rotation, poses[camera.name].rotation, atol=1e-9)
        assert camera.picture == tmp_path / "images" / camera.name
    assert (scene.unit, scene.notes, scene.mesh) == ("m", (), None)
    assert scene.cloud is not None
    assert scene.cloud.count == 20_000


def test_doubtful_cameras_are_labelled_and_noted(tmp_path: Path) -> None:
    out = write_output(tmp_path, turned_poses(3))
    run = json.loads((out / "run.json").read_text())
    run["poses"] = run.get("poses", {}) | {"doubts": {"lobby/001.png": "hardly confirmed"}}
    (out / "run.json").write_text(json.dumps(run))
    scene = open_scene(out)
    assert [camera.label for camera in scene.cameras] == ["lobby/000.png", "lobby/001.png (doubtful)", "lobby/002.png"]
    assert scene.notes == (
        "doubtful: lobby/001.png; the ranges of these cameras may be in the wrong place, see report.html",
    )


def test_what_is_missing_is_noted_and_the_rest_is_shown(tmp_path: Path) -> None:
    out = write_output(tmp_path / "a", turned_poses(2), points=0, metric=False)
    scene = open_scene(out)
    assert (scene.cloud, scene.unit) == (None, "scene units")
    assert "no cloud.ply" in scene.notes[0]
    scene = open_scene(write_output(tmp_path / "b", {}))
    assert scene.cameras == ()
    assert "no colmap/sparse/0" in scene.notes[0]
    (out / "run.json").write_text("{broken")
    assert "give --images" in " ".join(open_scene(out).notes)
    assert open_scene(out, images=tmp_path / "a" / "images").cameras[0].picture is not None


def test_nothing_to_show_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Give the output folder of a run"):
        open_scene(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        open_scene(tmp_path / "nowhere")
    (tmp_path / "bad.ply").write_text("nothing")
    with pytest.raises(InputError, match="not a PLY file"):
        open_scene(tmp_path / "bad.ply")


def test_a_cloud_without_points_is_as_none(tmp_path: Path) -> None:
    """The window took it for a cloud, and ended as an internal error: masks that cover all make one."""
    out = write_output(tmp_path, turned_poses(2))
    none = np.zeros((0, 3), np.float32)
    write_ply(out / "cloud.ply", PointCloud(none, none, np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8)))
    scene = open_scene(out)
    assert (scene.cloud, len(scene.cameras)) == (None, 2)
    assert "cloud.ply contains no points" in scene.notes[-1]
    with pytest.raises(InputError, match="contains no points"):
        open_scene(out / "cloud.ply")
    shutil.rmtree(out / "colmap")
    with pytest.raises(InputError, match=r"contains no cloud\.ply with points"):
        open_scene(out)


def test_lone_files_are_clouds_or_meshes(tmp_path: Path) -> None:
    out = write_output(tmp_path, turned_poses(1))
    cloud = open_scene(out / "cloud.ply")
    assert cloud.cloud is not None
    assert cloud.mesh is None
    (out / "mesh.ply").write_text(MESH)
    assert has_faces(out / "mesh.ply")
    assert open_scene(out / "mesh.ply").mesh == out / "mesh.ply"
    assert open_scene(out).mesh == out / "mesh.ply"


def test_files_that_a_workflow_writes_elsewhere_are_found(tmp_path: Path) -> None:
    out = write_output(tmp_path, turned_poses(1))
    (out / "draft").mkdir()
    (out / "cloud.ply").rename(out / "draft" / "cloud.ply")
    run = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(run | {"files": {"draft/cloud.ply": ""}}))
    scene = open_scene(out)
    assert scene.cloud is not None
    assert scene.cloud.path == out / "draft" / "cloud.ply"


def test_up_is_what_the_cameras_agree_on(tmp_path: Path) -> None:
    level = open_scene(write_output(tmp_path / "level", turned_poses(5, level=True)))
    np.testing.assert_allclose(level.up, UP, atol=1e-9)
    tumbled = open_scene(write_output(tmp_path / "tumbled", turned_poses(40)))
    np.testing.assert_allclose(tumbled.up, UP)
    for scene in (level, tumbled):
        assert scene.ahead @ scene.up == pytest.approx(0, abs=1e-9)


def test_up_is_minus_y_in_a_level_world(tmp_path: Path) -> None:
    out = write_output(tmp_path, {"a.png": Rigid3(rotation_from_rotvec([0.3, 0.0, 0.1]), np.zeros(3))}, points=0)
    tilted = open_scene(out)
    assert tilted.up[1] > -0.97
    run = json.loads((out / "run.json").read_text())
    run["poses"]["axes"] = "level"
    (out / "run.json").write_text(json.dumps(run))
    np.testing.assert_array_equal(open_scene(out).up, UP)


def test_a_display_needs_few_points_and_they_are_spread(tmp_path: Path) -> None:
    out = write_output(tmp_path, {})
    cloud = open_ply_points(out / "cloud.ply")
    few = drawn_cloud(cloud, budget=1000)
    assert len(few.points) == 1000
    assert few.total == 20_000
    everything = drawn_cloud(cloud, budget=0)
    assert len(everything.points) == 20_000
    places = {point.tobytes(): idx for idx, point in enumerate(everything.points)}
    chosen = np.array([places[point.tobytes()] for point in few.points])
    np.testing.assert_array_equal(chosen // 20, np.arange(1000))  # one of each stretch
    assert len(np.unique(np.diff(chosen))) > 10  # not at regular steps
    np.testing.assert_array_equal(drawn_cloud(cloud, budget=1000).points, few.points)


def test_colours_mean_what_the_legend_says(tmp_path: Path) -> None:
    cloud = drawn_cloud(open_ply_points(write_output(tmp_path, {}, quality=True) / "cloud.ply"))
    assert cloud.colorings == ("rgb", "confidence", "views", "normals", "height")
    photographed = color_cloud(cloud, "rgb", up=UP, unit="m").colors_rgb
    np.testing.assert_array_equal(photographed[:, 0], cloud.vertices["red"])
    heights = color_cloud(cloud, "height", up=UP, unit="m")
    ceiling, floor = (cloud.points[:, 1] < -1.49), (cloud.points[:, 1] > 1.49)
    assert heights.colors_rgb[ceiling, 0].min() > heights.colors_rgb[floor, 0].max()  # red above
    assert heights.colors_rgb[floor, 2].min() > heights.colors_rgb[ceiling, 2].max()  # blue below
    normals = color_cloud(cloud, "normals", up=UP, unit="m").colors_rgb
    assert cloud.normals is not None
    upward = cloud.normals[:, 1] < -0.5
    np.testing.assert_array_equal(np.unique(normals[upward], axis=0), [[128, 255, 128]])
    sure = color_cloud(cloud, "confidence", up=UP, unit="m").colors_rgb
    assert sure[cloud.vertices["confidence"] > 250, 0].min() > sure[cloud.vertices["confidence"] < 60, 0].max()
    assert "views that agree" in color_cloud(cloud, "views", up=UP, unit="m").legend


def test_colours_that_the_file_does_not_hold_are_refused(tmp_path: Path) -> None:
    cloud = drawn_cloud(open_ply_points(write_output(tmp_path, {}) / "cloud.ply"))
    with pytest.raises(UsageError, match="only by rgb, normals, height"):
        color_cloud(cloud, "confidence", up=UP, unit="m")
    bare = DrawnCloud(cloud.points, None, drop_fields(cloud.vertices, ["red", "green", "blue", "nx", "ny", "nz"]), 1)
    assert bare.colorings == ("rgb", "height")
    assert color_cloud(bare, "rgb", up=UP, unit="m").legend == "this cloud has no colours"


def test_pictures_are_found_small_and_large_and_missing_ones_are_plain(tmp_path: Path) -> None:
    out = write_output(tmp_path, turned_poses(2))
    original = decode_image(tmp_path / "images" / "lobby" / "000.png")
    camera = open_scene(out).cameras[0]
    np.testing.assert_array_equal(sphere_picture(camera, LARGE_WIDTH), original)
    assert sphere_picture(camera, 32).shape == (16, 32, 3)
    (out / "preview" / "lobby").mkdir(parents=True)
    write_preview(out / "preview" / "lobby" / "000.jpg", original, np.ones((64, 128), np.float32))
    (tmp_path / "images" / "lobby" / "000.png").unlink()
    camera = open_scene(out).cameras[0]
    by_preview = sphere_picture(camera, SMALL_WIDTH)
    assert by_preview.shape == (SMALL_WIDTH // 2, SMALL_WIDTH, 3)
    assert np.abs(by_preview[::4, ::4].astype(int) - original).mean() < 6
    (tmp_path / "images" / "lobby" / "001.png").write_bytes(b"broken")
    plain = sphere_picture(open_scene(out).cameras[1], SMALL_WIDTH)
    assert plain[0].mean() > plain[-1].mean()


def test_one_group_is_shown_at_a_time_and_the_others_are_named(tmp_path: Path) -> None:
    poses = turned_poses(3)
    out = write_output(tmp_path, poses, metric=False)
    other = write_output(tmp_path / "other", turned_poses(2, seed=5), points=50)
    shutil.copy(other / "cloud.ply", out / "cloud_1.ply")
    shutil.copytree(other / "colmap" / "sparse" / "0", out / "colmap" / "sparse" / "1")
    run = json.loads((out / "run.json").read_text())
    run["poses"]["groups"] = [{"images": list(poses), "metric": False}, {"images": ["x", "y"], "metric": True}]
    (out / "run.json").write_text(json.dumps(run))
    for group, cameras, points, unit, told in (
        (0, 3, 20_000, "scene units", "1 (2 images)"),
        (1, 2, 50, "m", "0 (3 images)"),
    ):
        scene = open_scene(out, group=group)
        assert scene.cloud is not None
        assert (len(scene.cameras), scene.cloud.count, scene.unit) == (cameras, points, unit)
        assert f"this is group {group} of 2" in scene.notes[0]
        assert told in scene.notes[0]
    with pytest.raises(UsageError, match=r"--group 2: .* has 2 groups, numbered from 0"):
        open_scene(out, group=2)
    with pytest.raises(UsageError, match="has 1 group,"):
        open_scene(other, group=1)
