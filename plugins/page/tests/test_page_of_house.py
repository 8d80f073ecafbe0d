"""The page of a tour shows the whole house, also the panoramas that links alone say where they are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_run import NAMES, box_run
from pano_mvs_page.mesh_file import SharedMesh, joined_meshes, run_mesh
from pano_mvs_page.share import page_from_world, share_run
from pano_mvs_page.shown import shown_of
from test_share import value_of

from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.io.house_file import house_document
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.scene import House
from pano_mvs.scene.image_file import write_png
from tests.synthetic.viewed_scenes import turned_poses

ATTIC, AWAY = "attic.png", "away.png"


def with_house(run: RunOutput, images: Path) -> tuple[RunOutput, dict[str, Rigid3]]:
    """Add a house to the output of a run: its last camera and two other panoramas are single there."""
    cameras = turned_poses(3, level=True)
    cameras[NAMES[2]] = Rigid3.from_center(cameras[NAMES[2]].rotation, np.array([4.0, 0.0, 1.0]))
    cameras[ATTIC] = Rigid3.from_center(np.eye(3), np.array([-5.0, 0.0, 2.0]))
    cameras[AWAY] = Rigid3.from_center(np.eye(3), np.array([9.0, 0.0, 0.0]))
    for name in (ATTIC, AWAY):
        write_png(images / name, np.full((128, 256, 3), 90, np.uint8))
    house = House(
        names=tuple(cameras),
        rotations=np.array([pose.rotation for pose in cameras.values()]),
        translations=np.array([pose.translation for pose in cameras.values()]),
        parts=np.array([0, 0, 1, 2, 3], np.int32),
        groups=np.array([0, 0, -1, -1, -1], np.int32),
        scales=np.ones(5),
        placed_by=("matches", "matches", "links", "links", "nothing"),
        center_stds=np.array([0.0, 0.0, 1.0, 1.0, np.inf]),
        turn_stds_rad=np.array([0.0, 0.0, 0.1, 0.1, np.inf]),
        links=((ATTIC,), (), (), (NAMES[0], "gone.png"), ()),
        camera_height=1.5,
    )
    (run.out / "house.json").write_text(json.dumps(house_document(house)))
    return load(run.out), cameras


def scene_of(folder: Path) -> dict[str, Any]:
    scene: dict[str, Any] = value_of(folder / "data" / "scene.js")
    return scene


def test_single_panoramas_stand_where_links_say(tmp_path: Path) -> None:
    run, cameras = with_house(box_run(tmp_path, points=2_000), tmp_path / "images")
    shared = share_run(run, tmp_path / "page", images=tmp_path / "images")
    assert shared.panoramas == 5
    assert any("2 of 5 panoramas are; their places are rough" in note for note in shared.notes)
    shown = {camera["name"]: camera for camera in scene_of(tmp_path / "page")["cameras"]}
    assert list(shown) == [*NAMES, ATTIC, AWAY]
    frame = page_from_world(list(cameras.values()))
    for name, pose in cameras.items():
        assert shown[name]["center"] == pytest.approx(frame.apply(pose.center))
    assert [camera.get("placed", "")[:15] for camera in shown.values()] == [
        "", "", "placed by links", "placed by links", "beside the hous",
    ]  # fmt: skip


def test_each_scene_has_its_links_and_doubtful_ones_no_ranges(tmp_path: Path) -> None:
    run, _ = with_house(box_run(tmp_path, points=2_000), tmp_path / "images")
    share_run(run, tmp_path / "page", images=tmp_path / "images")
    cameras = scene_of(tmp_path / "page")["cameras"]
    assert [camera["ranges"] is None for camera in cameras] == [False, False, True, True, True]
    assert [camera.get("leadsTo") for camera in cameras] == [[3], [], [], [0], []]


def test_what_doubtful_cameras_saw_is_not_shown_and_a_part_moves_as_a_whole(tmp_path: Path) -> None:
    run, _ = with_house(box_run(tmp_path, points=2_000), tmp_path / "images")
    alone = share_run(run, tmp_path / "page", images=tmp_path / "images")
    assert 0 < alone.points < 2_000, "points nearest to the doubtful camera are left out"
    document = json.loads((run.out / "house.json").read_text())
    for row in document["panoramas"][:2]:
        row["center"][0] += 50.0
    (run.out / "house.json").write_text(json.dumps(document))
    moved = shown_of(load(run.out), with_mesh=False)
    before = box_run(tmp_path / "again", points=2_000).cloud
    assert moved.cloud is not None
    assert before is not None
    assert len(moved.cloud) == alone.points
    assert np.median(moved.cloud.points_in_world[:, 0]) > 45.0


def test_a_mesh_keeps_what_certain_cameras_saw(tmp_path: Path) -> None:
    run, _ = with_house(box_run(tmp_path, points=2_000, mesh=True), tmp_path / "images")
    whole, _ = run_mesh(run)
    mesh = shown_of(run, with_mesh=True).mesh
    assert whole is not None
    assert mesh is not None
    assert 0 < len(mesh.faces) < len(whole.faces)
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices))), "vertices that no face uses are gone"


def test_the_unit_is_that_of_the_largest_part(tmp_path: Path) -> None:
    run, _ = with_house(box_run(tmp_path, points=2_000, metric=True), tmp_path / "images")
    assert shown_of(run, with_mesh=False).metric
    document = json.loads((run.out / "house.json").read_text())
    for number, row in enumerate(document["panoramas"]):
        row |= {"part": number, "group": None, "placed_by": "links"}
    (run.out / "house.json").write_text(json.dumps(document))
    shown = shown_of(load(run.out), with_mesh=False)
    assert not shown.metric
    assert shown.cloud is None
    assert any("all cameras that see it are doubtful" in note for note in shown.notes)


def test_a_damaged_house_file_is_named_and_the_largest_group_shown(tmp_path: Path) -> None:
    run, _ = with_house(box_run(tmp_path, points=2_000), tmp_path / "images")
    (run.out / "house.json").write_text("{")
    shared = share_run(load(run.out), tmp_path / "page", images=tmp_path / "images")
    assert shared.panoramas == 3
    assert any("house.json" in note for note in shared.notes)


def test_a_house_that_an_earlier_run_left_is_not_used(tmp_path: Path) -> None:
    run, _ = with_house(box_run(tmp_path, points=2_000), tmp_path / "images")
    summary = json.loads((run.out / "run.json").read_text())
    summary["left_over"] = {"house.json": "export.house"}
    (run.out / "run.json").write_text(json.dumps(summary))
    assert share_run(load(run.out), tmp_path / "page", images=tmp_path / "images").panoramas == 3


def corner(texture_hw: tuple[int, int], gray: int) -> SharedMesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    uv = np.array([[0, 0], [1, 0], [0, 1]], np.float32)
    texture = np.full((*texture_hw, 3), gray, np.uint8)
    return SharedMesh(vertices, np.array([[0, 1, 2]], np.int32), uv=uv, texture=texture)


def test_textures_of_several_meshes_become_one() -> None:
    first, second = corner((4, 8), 10), corner((6, 4), 200).moved(Similarity3(2.0, np.eye(3), np.array([5.0, 0, 0])))
    joined = joined_meshes([first, second])
    assert joined is not None
    assert joined.texture is not None
    assert joined.uv is not None
    assert joined.texture.shape == (10, 8, 3)
    assert joined.faces.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert joined.vertices[4].tolist() == [7.0, 0.0, 0.0]
    height, width = joined.texture.shape[:2]
    inside = joined.uv.reshape(2, 3, 2).mean(axis=1)  # the middle of each triangle
    places = [(int((1 - v) * height), int(u * width)) for u, v in inside]
    assert [joined.texture[place][0] for place in places] == [10, 200]


def test_meshes_with_colours_are_joined_unless_one_has_a_texture() -> None:
    plain = SharedMesh(
        np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32), colors_rgb=np.zeros((3, 3), np.uint8)
    )
    joined = joined_meshes([plain, plain])
    assert joined is not None
    assert joined.colors_rgb is not None
    assert len(joined.vertices) == len(joined.colors_rgb) == 6
    assert joined_meshes([]) is None
    assert joined_meshes([plain, corner((2, 2), 1)]) is not None
