"""What clicks, drags and keys do, without a window."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pano_mvs_viewer.cloud_colors import DrawnCloud, drawn_cloud
from pano_mvs_viewer.controller import Tour, camera_under, pixel_readout, point_under
from pano_mvs_viewer.shown_scene import ShownCamera, ShownScene, open_scene
from pano_mvs_viewer.viewpoint import (
    Viewpoint,
    box_of,
    length_text,
    looking_along,
    outer_box,
    outside_view,
    sphere_radius,
)

from pano_mvs.algorithms.points.plan_grid import bar_length, bar_text
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, ray_from_pixel
from pano_mvs.io.ranges import write_confidence_png, write_range_tiff
from tests.synthetic.viewed_scenes import HALF, turned_poses, write_output

SIZE = (900, 600)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> tuple[ShownScene, DrawnCloud | None]:
    return shown_from(write_output(tmp_path_factory.mktemp("tour"), turned_poses(6), points=150_000))


@pytest.fixture
def tour(shown: tuple[ShownScene, DrawnCloud | None]) -> Tour:
    return through(*shown)


def tour_of(out: Path) -> Tour:
    return through(*shown_from(out))


def shown_from(out: Path) -> tuple[ShownScene, DrawnCloud | None]:
    scene = open_scene(out)
    return scene, drawn_cloud(scene.cloud) if scene.cloud is not None else None


def through(scene: ShownScene, cloud: DrawnCloud | None) -> Tour:
    points = cloud.points if cloud is not None else np.zeros((0, 3))
    return Tour(scene, cloud, box_of(points, scene.centers))


def place_of(point: np.ndarray, view: Viewpoint) -> tuple[float, float]:
    """Return where in the window a point is."""
    x, y, z = view.axes @ (point - view.eye)
    scale = SIZE[1] / 2 / (view.height / 2 if view.height else z * np.tan(np.deg2rad(view.angle_deg) / 2))
    return SIZE[0] / 2 + x * scale, SIZE[1] / 2 + y * scale


@pytest.mark.parametrize("view", ["overview", "top", "front"])
def test_clicking_a_camera_steps_inside_and_out_again(tour: Tour, view: str) -> None:
    tour.see(view)
    before = tour.state.viewpoint
    distances = np.linalg.norm(tour.centers - before.eye, axis=1)
    nearest = int(np.argmin(distances))
    tour.click(*place_of(tour.centers[nearest], before), SIZE)
    assert (tour.state.inside, tour.state.viewpoint.height) == (nearest, 0)
    np.testing.assert_allclose(tour.state.viewpoint.eye, tour.centers[nearest])
    tour.step_out()
    assert tour.state.inside is None
    assert tour.state.viewpoint is before


@pytest.mark.parametrize("view", ["top", "front"])
def test_the_sparse_ends_of_a_corridor_are_in_the_window(tour: Tour, view: str) -> None:
    """All but the hundredth part of the points lies about the cameras; that part is the rest of the corridor."""
    assert tour.cloud is not None
    points = tour.cloud.points.copy()
    points[::120, ::2] *= np.linspace(1, 1.7, len(points[::120]), dtype=np.float32)[:, None]
    corridor = Tour(tour.scene, replace(tour.cloud, points=points), box_of(points, tour.scene.centers))
    corridor.see(view)
    seen = np.array([place_of(point, corridor.state.viewpoint) for point in points[::120]])
    assert np.mean((seen >= 0) & (seen <= SIZE)) > 0.99


def test_a_stray_point_does_not_shrink_the_plan(tour: Tour) -> None:
    assert tour.cloud is not None
    stray = np.concatenate([tour.cloud.points, np.full((500, 3), 1e4, np.float32)])
    box = box_of(stray, tour.scene.centers)
    assert np.ptp(outer_box(stray, box), axis=0).max() <= 1.5001 * np.ptp(box, axis=0).max()
    assert outer_box(stray[:0], box) is box


def test_a_click_beside_all_cameras_does_nothing(tour: Tour) -> None:
    before = tour.state
    tour.click(1, 1, SIZE)
    assert tour.state is before


def test_one_goes_on_from_camera_to_camera_and_comes_back_to_the_start(tour: Tour) -> None:
    start = tour.state.viewpoint
    tour.key("Right")
    assert tour.state.inside == 0
    looking = tour.state.viewpoint.axes[2]
    tour.key("Right")
    assert tour.state.inside == 1
    np.testing.assert_allclose(tour.state.viewpoint.axes[2], looking, atol=1e-12)
    other = next(idx for idx in range(6) if (tour.centers[idx] - tour.centers[1]) @ looking > 0.3)
    tour.click(*place_of(tour.centers[other], tour.state.viewpoint), SIZE)
    assert tour.state.inside == other
    tour.key("Escape")
    assert tour.state.viewpoint is start
    tour.key("Left")
    assert tour.state.inside == 5


@pytest.mark.parametrize("offset", [-1e-9, -0.0, 1e-9])
def test_an_angle_that_rounds_to_zero_has_no_sign(offset: float) -> None:
    """Regression: the last bit of a machine's arithmetic showed as "azimuth -0.0°"."""
    camera = ShownCamera("a.png", Rigid3.identity(), None, None)
    assert pixel_readout(camera, np.array([offset, -offset, 1.0]), "m") == "azimuth 0.0°, elevation 0.0°"


def test_a_click_inside_reads_the_pixel_for_inspect(tmp_path: Path) -> None:
    folder = write_output(tmp_path, turned_poses(6), points=150_000)
    ranges = np.full((64, 128), 2.5, np.float32)
    ranges[:, 96:] = np.nan
    for kind in ("range", "confidence"):
        (folder / kind / "lobby").mkdir(parents=True)
    write_range_tiff(folder / "range" / "lobby" / "003.tiff", ranges)
    write_confidence_png(folder / "confidence" / "lobby" / "003.png", np.full((64, 128), 201, np.uint8))
    tour = tour_of(folder)
    tour.key("k")  # no camera in the way
    tour.see("inside:002")
    tour.click(450, 300, SIZE)
    assert tour.state.message == "azimuth 0.0°, elevation 0.0°"
    tour.see("inside:003")
    rotation = tour.scene.cameras[3].cam_from_world.rotation
    for column, row, said in ((70, 20, "range 2.500 m, confidence 201"), (110, 40, "no range")):
        along = rotation.T @ ray_from_pixel([column + 0.5, row + 0.5], (64, 128))
        tour.moved_to(looking_along(tour.centers[3], along, tour.scene.up))
        tour.click(450, 300, SIZE)
        assert tour.state.message.startswith(f"pixel {column} {row}: {said}")
    (folder / "range" / "lobby" / "003.tiff").write_bytes(b"broken")
    tour.click(450, 300, SIZE)
    assert "a range map is a one-channel float32 TIFF" in tour.state.message


def test_inside_by_name_looks_where_the_camera_looked(tour: Tour) -> None:
    tour.see("inside:003")
    assert tour.state.inside == 3
    np.testing.assert_allclose(tour.state.viewpoint.axes[2], tour.scene.cameras[3].cam_from_world.rotation[2])
    with pytest.raises(UsageError, match=r"no camera 'attic'; there are: lobby/000\.png"):
        tour.see("inside:attic")
    with pytest.raises(UsageError, match="no view 'below'"):
        tour.see("below")


def test_two_clicks_measure_what_the_cloud_says(tour: Tour) -> None:
    tour.key("m")
    tour.key("x")
    view = tour.state.viewpoint
    clicked: list[NDArray[Any]] = []
    for _ in range(2):
        tour.click(*place_of(HALF * np.array([0.2, 1, len(clicked) - 0.5]), view), SIZE)
        clicked.append(tour.state.picked[-1])
    assert tour.distance == pytest.approx(np.linalg.norm(clicked[0] - clicked[1]))
    assert tour.state.message == f"{tour.distance:.3f} m"

    for point in clicked:
        assert np.isclose(np.abs(point), HALF).any()
    tour.click(*place_of(clicked[0], view), SIZE)  # a third click begins anew
    assert tour.distance is None
    tour.click(2, 2, SIZE)
    assert "no point there" in tour.state.message
    tour.key("Escape")
    assert (tour.state.measuring, tour.state.picked) == (False, ())


def test_without_a_scale_the_points_are_shown_for_the_command_that_sets_it(tour: Tour) -> None:
    tour.scene = replace(tour.scene, unit="scene units")
    tour.key("m")
    tour.key("x")
    view = tour.state.viewpoint
    for z in (-0.5, 0.5):
        tour.click(*place_of(HALF * np.array([0.2, 1, z]), view), SIZE)
    found = re.fullmatch(r"[\d.]+ scene units from (\S+) to (\S+)", tour.state.message)
    assert found
    ends = [np.array([float(word) for word in text.split(",")]) for text in found.groups()]
    np.testing.assert_allclose(ends, tour.state.picked, atol=2e-3)


def test_points_that_turn_their_back_are_not_picked(tour: Tour) -> None:
    """From above the ceiling is not drawn, so a click goes through it to the floor."""
    tour.see("top")
    for key, height in (("m", HALF[1]), ("x", -HALF[1])):
        tour.key(key)
        tour.click(430, 310, SIZE)
        assert tour.state.picked[-1][1] == pytest.approx(height)


def test_measuring_works_inside_a_panorama(tour: Tour) -> None:
    tour.see("inside:000")
    tour.key("m")
    tour.click(450, 300, SIZE)
    picked = tour.state.picked[0]
    eye = tour.state.viewpoint.eye
    along = tour.state.viewpoint.axes[2]
    assert (picked - eye) @ along / np.linalg.norm(picked - eye) > 0.999
    assert tour.state.inside == 0


def test_keys_change_what_is_shown(tmp_path: Path) -> None:
    tour = tour_of(write_output(tmp_path, turned_poses(2), quality=True))
    seen = [tour.state.coloring]
    for _ in range(5):
        tour.key("c")
        seen.append(tour.state.coloring)
    assert seen == ["rgb", "confidence", "views", "normals", "height", "rgb"]
    for key, name in {
        "l": "labels",
        "k": "cameras",
        "b": "blended",
        "x": "backs",
        "d": "all_points",
        "h": "help",
    }.items():
        before = getattr(tour.state, name)
        assert tour.key(key)
        assert getattr(tour.state, name) is not before
    assert not tour.key("z")


def test_hovering_tells_which_camera_is_there(tour: Tour) -> None:
    nearest = int(np.argmin(np.linalg.norm(tour.centers - tour.state.viewpoint.eye, axis=1)))
    assert tour.hover(*place_of(tour.centers[nearest], tour.state.viewpoint), SIZE)
    assert tour.state.hovered == nearest
    assert not tour.hover(*place_of(tour.centers[nearest], tour.state.viewpoint), SIZE)
    tour.key("k")
    assert tour.hover(*place_of(tour.centers[nearest], tour.state.viewpoint), SIZE)
    assert tour.state.hovered is None


def test_a_tour_without_cloud_or_without_cameras_goes_on(tmp_path: Path) -> None:
    bare = tour_of(write_output(tmp_path / "bare", turned_poses(1), points=0))
    bare.key("m")
    bare.click(450, 300, SIZE)
    assert "no cloud" in bare.state.message
    assert not bare.key("c") or bare.state.coloring == "rgb"
    bare.corners = np.array([[0, 0, 0], [0, 0, 1]], np.float32)
    bare.see("top")
    for corner in bare.corners:
        bare.click(*place_of(corner, bare.state.viewpoint), SIZE)
    assert bare.distance == pytest.approx(1)
    alone = tour_of(write_output(tmp_path / "alone", {}))
    alone.key("Right")
    alone.click(450, 300, SIZE)
    assert alone.state.inside is None


def test_the_nearest_of_several_things_under_the_pointer_is_taken() -> None:
    start, ahead = np.zeros(3), np.array([0.0, 0, 1])
    centers = np.array([[0.0, 0, 9], [0, 0.05, 5], [0, 0, -3], [2, 0, 4]])
    assert camera_under(start, ahead, centers, radius=0.1) == 1
    assert camera_under(start, -ahead, centers, radius=0.1) == 2
    assert camera_under(start, np.array([0, 1.0, 0]), centers, radius=0.1) is None
    points = np.array([[0, 0, 8], [0.001, 0, 6], [0.02, 0, 6.01], [0, 0.5, 2], [0, 0, -1]], np.float32)
    assert point_under(start, ahead, points) == 1
    away = np.tile(np.array([0, 0, 1], np.float32), (5, 1))
    assert point_under(start, ahead, points, normals=away) is None
    away[0] = [0, 0, -1]
    assert point_under(start, ahead, points, normals=away) == 0
    assert point_under(start, ahead, points[:0]) is None


def test_sizes_suit_the_scene() -> None:
    box = np.array([[0.0, 0, 0], [10, 3, 8]])
    apart = np.array([[1.0, 1, 1], [2, 1, 1], [3, 1, 1]])
    assert sphere_radius(apart, box) == pytest.approx(0.18)
    assert sphere_radius(apart * 0.4, box) == pytest.approx(0.008 * np.linalg.norm([10, 3, 8]))
    assert sphere_radius(apart * 0.1, box) == pytest.approx(0.04)
    assert sphere_radius(apart[:1], box) == sphere_radius(apart * 1e3, box)
    assert [bar_length(extent) for extent in (4.0, 8.1, 19.9, 20, 0.3)] == [1, 2, 2, 5, 0.05]
    assert length_text(0.4321, "m") == "43.2 cm"
    assert length_text(2.5, "m") == "2.500 m"
    assert length_text(1.23456, "scene units") == "1.235 scene units"
    assert (bar_text(1, "scene units"), bar_text(0.5, "scene units"), bar_text(2, "m")) == (
        "1 scene unit",
        "0.5 scene units",
        "2 m",
    )
    flat = box_of(np.zeros((0, 3)), np.zeros((1, 3)))
    assert np.ptp(flat, axis=0).min() > 0


UP, AHEAD = np.array([0.0, -1, 0]), np.array([0.0, 0, 1])
angles = st.floats(-80, 80)


def test_the_windows_axes_are_those_of_a_camera() -> None:
    np.testing.assert_allclose(looking_along([1, 2, 3], AHEAD, UP).axes, np.eye(3), atol=1e-12)


def test_the_middle_of_the_window_is_the_target_and_its_edges_are_at_the_angle() -> None:
    view = Viewpoint(np.zeros(3), np.array([0.0, 0, 5]), UP, 60.0)
    np.testing.assert_allclose(view.ray(450, 300, SIZE)[1], AHEAD, atol=1e-12)
    upper = view.ray(450, 0, SIZE)[1]
    assert np.rad2deg(np.arcsin(-upper[1])) == pytest.approx(30)
    right = view.ray(900, 300, SIZE)[1]
    assert right[0] / right[2] == pytest.approx(1.5 * np.tan(np.deg2rad(30)))


@given(angles, angles, st.floats(-40, 40), st.floats(-40, 40))
def test_what_was_under_the_pointer_stays_there(azimuth: float, elevation: float, dx: float, dy: float) -> None:
    theta, phi = np.deg2rad([azimuth, elevation * 0.5])
    along = np.array([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)])
    view = looking_along([1, 2, 3], along, UP)
    turned = view.turned(dx, dy, window_height=600)
    np.testing.assert_allclose(turned.eye, view.eye)
    seen = turned.ray(450 + dx, 300 + dy, SIZE)[1]
    # Exact for the direction, nearly for the amount: a window is flat, and turning is not.
    assert np.rad2deg(np.arccos(min(1.0, float(seen @ along)))) < 2.6
    if abs(dx) > 5:
        right = view.axes[0]
        assert np.sign(turned.axes[2] @ right) == -np.sign(dx)
    if abs(dy) > 5:
        assert np.sign(turned.axes[2] @ UP - along @ UP) == np.sign(dy)


def test_one_never_looks_over_the_pole() -> None:
    view = looking_along([0, 0, 0], AHEAD, UP)
    for _ in range(40):
        view = view.turned(0, 300, window_height=600)
    assert 0.99 < view.axes[2] @ UP < 1
    np.testing.assert_allclose(view.axes[0], [1, 0, 0], atol=1e-6)


def test_zooming_keeps_within_reason() -> None:
    view = looking_along([0, 0, 0], AHEAD, UP)
    assert view.zoomed(1).angle_deg < view.angle_deg < view.zoomed(-1).angle_deg
    assert view.zoomed(99).angle_deg == 15
    assert view.zoomed(-99).angle_deg == 110


@pytest.mark.parametrize("name", ["overview", "top", "front"])
@pytest.mark.parametrize("aspect", [0.6, 1.0, 2.0])
def test_all_of_the_scene_is_in_the_window(name: str, aspect: float) -> None:
    rng = np.random.default_rng(3)
    box = np.sort(rng.normal(size=(2, 3)) * [4, 1, 9], axis=0)
    view = outside_view(name, box, UP, ahead=AHEAD, aspect=aspect)
    right, down, forward = view.axes
    for corner in np.array(np.meshgrid(*box.T)).reshape(3, -1).T - view.eye:
        depth = view.height / 2 if view.height else (corner @ forward) * np.tan(np.deg2rad(view.angle_deg) / 2)
        assert corner @ forward > 0
        assert abs(corner @ down) <= depth
        assert abs(corner @ right) <= depth * aspect
    if name == "top":
        np.testing.assert_allclose([right, down, forward], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
