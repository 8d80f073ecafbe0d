"""Rooms of panoramas without ranges are shown as their pictures outline them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from box_run import box_run
from numpy.typing import NDArray
from pano_mvs_page.outlined import closed_walls, room_cloud, room_map, room_mesh, room_ranges
from pano_mvs_page.share import share_run
from pano_mvs_page.shown import shown_of
from test_page_of_house import ATTIC, AWAY, scene_of, with_house

from pano_mvs.geometry import Rigid3, spiral_rays
from pano_mvs.io.house_file import house_document, read_house
from pano_mvs.results.run_output import load
from pano_mvs.scene import RoomOutline
from tests.synthetic.drawn_rooms import TILT, box, true_distances

HEIGHT = 1.5
POSE = Rigid3.from_center(TILT, np.array([2.0, -1.0, 3.0]))


def outline(probabilities: NDArray[np.float32] | None = None) -> RoomOutline:
    distances = true_distances().astype(np.float32)
    sure = np.full(360, 0.9, np.float32)
    return RoomOutline(TILT, float(np.radians(25.0)), 0.7, distances, sure if probabilities is None else probabilities)


def off_surfaces(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return how far points of the house are from floor, ceiling and walls of the room."""
    level = (points - POSE.center) / HEIGHT
    gaps = [np.abs(level[:, 1] - 1), np.abs(level[:, 1] + 0.7)]
    for number, distance in enumerate((1.4, 2.2, 1.9, 1.1)):
        azimuth = np.radians(25.0 + 90 * number)
        gaps.append(np.abs(level @ [np.sin(azimuth), 0.0, np.cos(azimuth)] - distance))
    return np.asarray(HEIGHT * np.min(gaps, axis=0))


def test_ranges_end_at_floor_ceiling_and_walls() -> None:
    rays = spiral_rays(4000)
    ranges = room_ranges(outline(), rays, camera_height=HEIGHT)
    off = off_surfaces(POSE.inverse().apply(rays * ranges[:, None]))
    assert np.percentile(off, 98) < 0.001
    assert off.max() < 0.03, "corners are between two azimuths"
    unsure = np.full(360, 0.9, np.float32)
    unsure[40:75] = 0.2
    for found, least, most in ((outline(), 0.05, 0.05), (outline(unsure), 0.05, 0.4)):
        shown, deviations = room_map(found, (32, 64), camera_height=HEIGHT)
        assert shown.shape == deviations.shape == (32, 64)
        assert (deviations.min(), deviations.max()) == (np.float32(least), np.float32(most))


def test_walls_that_are_probably_wrong_are_closed_by_those_beside_them() -> None:
    unsure = np.full(360, 0.9, np.float32)
    unsure[[*range(40, 75), *range(350, 360), *range(4)]] = 0.2
    unsure[[57, 58]] = 0.9  # a sliver
    wrong = outline(unsure).distances.copy()
    wrong[unsure < 0.5] *= 3
    wrong[[57, 58]] *= 3
    room = RoomOutline(TILT, float(np.radians(25.0)), 0.7, wrong, unsure)
    assert np.allclose(closed_walls(room), true_distances(), rtol=1e-4)


def test_where_hardly_a_wall_is_known_nothing_is_closed() -> None:
    only = np.full(360, 0.1, np.float32)
    only[20:40] = 0.9
    closed = closed_walls(outline(only))
    assert np.isfinite(closed[20:40]).all()
    assert np.isnan(closed[120:300]).all(), "the wall is not behind the camera"
    assert np.nanmax(closed) < 1.5 * true_distances()[20:40].max()
    assert np.isnan(room_ranges(outline(only), np.array([[0.0, -0.2, -1.0]]), camera_height=1.0)).all()
    assert np.isnan(closed_walls(outline(np.zeros(360, np.float32)))).all()


def test_points_and_triangles_are_on_surfaces_of_the_room() -> None:
    picture = box()
    cloud = room_cloud(outline(), picture, POSE, camera_height=HEIGHT)
    cloud.check()
    assert off_surfaces(cloud.points_in_world).max() < 0.03
    below = cloud.colors_rgb[cloud.points_in_world[:, 1] > POSE.center[1] + 0.99 * HEIGHT]
    assert np.abs(below.astype(float) - [150, 110, 70]).mean() < 3, "the floor has its colour"
    assert cloud.points_in_world[:, 1].min() > POSE.center[1] - 0.7 * HEIGHT, "the ceiling would hide the room"
    for textured in (True, False):
        mesh = room_mesh(outline(), picture, POSE, camera_height=HEIGHT, textured=textured)
        middle = mesh.vertices[mesh.faces].mean(axis=1)
        assert off_surfaces(mesh.vertices).max() < 0.03
        assert np.percentile(off_surfaces(middle), 95) < 0.02
        # Triangles face the camera.
        first, second, third = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        normals = np.cross(second - first, third - first)
        towards = np.sum(normals * (POSE.center - middle), axis=1)
        assert (towards > -1e-7).all()
        assert (mesh.uv is not None) == (mesh.colors_rgb is None) == textured


def test_an_opening_leaves_no_triangles_in_the_air() -> None:
    distances = true_distances().astype(np.float32)
    distances[60:80] *= 1.7  # seen through an opening
    room = RoomOutline(TILT, float(np.radians(25.0)), 0.7, distances, np.full(360, 0.9, np.float32))
    mesh = room_mesh(room, box(), POSE, camera_height=HEIGHT, textured=False)
    corners = mesh.vertices[mesh.faces]
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert lengths.max() < 1.2, "the wall behind the opening is 1.5 units farther or more"


@pytest.mark.slow
@pytest.mark.parametrize("mesh", [False, True])
def test_the_page_shows_rooms_that_links_place(tmp_path: Path, mesh: bool) -> None:
    run, cameras = with_house(box_run(tmp_path, points=2_000, mesh=mesh), tmp_path / "images")
    before = shown_of(run, with_mesh=True)
    house = read_house(run.out / "house.json").with_rooms({ATTIC: outline(), AWAY: outline(), "000.png": outline()})
    (run.out / "house.json").write_text(json.dumps(house_document(house)))
    run = load(run.out)
    share = share_run(run, tmp_path / "page", images=tmp_path / "images")
    assert any("2 rooms without ranges are drawn as the picture outlines them" in note for note in share.notes)
    shown = {camera["name"]: camera for camera in scene_of(tmp_path / "page")["cameras"]}
    assert shown[ATTIC]["ranges"] is not None
    assert shown[ATTIC]["sigmas"] is not None
    after = shown_of(run, with_mesh=True, picture=lambda _: box())
    assert before.cloud is not None
    assert after.cloud is not None
    added = after.cloud.points_in_world[len(before.cloud) :]
    centers = np.array([cameras[name].center for name in (ATTIC, AWAY)])
    apart = np.linalg.norm(added[:, None, [0, 2]] - centers[:, [0, 2]], axis=2).min(axis=1)
    assert apart.max() < 1.5 * 4
    # A mesh would hide the cloud of the groups, if these have none.
    assert (before.mesh is not None) == (after.mesh is not None) == mesh
    if before.mesh is not None and after.mesh is not None:
        assert len(after.mesh.faces) > len(before.mesh.faces)


def test_many_rooms_are_coarser() -> None:
    one, many = (room_mesh(outline(), box(), POSE, camera_height=HEIGHT, textured=True, count=count)
                 for count in (1, 40))  # fmt: skip
    assert one.texture is not None
    assert many.texture is not None
    assert 40 * len(many.faces) < 450_000 < 40 * len(one.faces)
    assert 40 * many.texture.shape[0] * many.texture.shape[1] < 9_000_000
    assert off_surfaces(many.vertices).max() < 0.03


def test_a_room_of_which_no_wall_is_known_is_not_drawn(tmp_path: Path) -> None:
    run, _ = with_house(box_run(tmp_path, points=2_000), tmp_path / "images")
    unknown = outline(np.zeros(360, np.float32))
    document = house_document(read_house(run.out / "house.json").with_rooms({ATTIC: unknown}))
    (run.out / "house.json").write_text(json.dumps(document))
    shown = shown_of(load(run.out), with_mesh=True, picture=lambda _: box())
    assert all(camera.room is None for camera in shown.cameras)
    assert len(shown.notes) == 1


def test_rooms_without_a_camera_height_or_a_picture_are_left_out(tmp_path: Path) -> None:
    run, _ = with_house(box_run(tmp_path, points=2_000), tmp_path / "images")
    house = read_house(run.out / "house.json").with_rooms({ATTIC: outline()})
    document = house_document(house)
    (run.out / "house.json").write_text(json.dumps(document))
    assert len(shown_of(load(run.out), with_mesh=True).notes) == 1
    document["camera_height"] = None
    (run.out / "house.json").write_text(json.dumps(document))
    shown = shown_of(load(run.out), with_mesh=True, picture=lambda _: box())
    assert all(camera.room is None for camera in shown.cameras)
