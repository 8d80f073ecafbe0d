"""The real plotter, off screen: what is drawn where, and what its mouse and keys do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from pano_mvs_viewer.cloud_colors import drawn_cloud
from pano_mvs_viewer.controller import Tour
from pano_mvs_viewer.shown_scene import open_scene
from pano_mvs_viewer.view import quiet_vtk, require_display, require_drawing, require_window
from pano_mvs_viewer.viewpoint import Viewpoint, box_of
from pano_mvs_viewer.window import TEXTURED, SceneWindow
from test_shown_scene import MESH
from test_viewer_tour import place_of

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ply import write_ply_mesh
from pano_mvs.scene.upright import z_up_from_world
from tests.synthetic.viewed_scenes import HALF, turned_poses, world_color, write_output

SIZE = (900, 600)


@pytest.fixture
def windows() -> Iterator[list[SceneWindow]]:
    require_drawing()  # else VTK takes the tests down with it
    quiet_vtk()
    opened: list[SceneWindow] = []
    yield opened
    for window in opened:
        window.close()


def window_on(out: Path, windows: list[SceneWindow], *, budget: int = 2_000_000, view: str = "overview") -> SceneWindow:
    scene = open_scene(out)
    cloud = drawn_cloud(scene.cloud, budget=budget) if scene.cloud is not None else None
    points = cloud.points if cloud is not None else np.zeros((0, 3))
    tour = Tour(scene, cloud, box_of(points, scene.centers), aspect=1.5)
    tour.see(view)
    windows.append(SceneWindow(tour, size_wh=SIZE, off_screen=True, budget=budget))
    return windows[-1]


def seen_at(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    """Return the median colour around a place: single pixels may be drawn otherwise."""
    column, row = int(x), int(y)
    result: np.ndarray = np.median(picture[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3), axis=0)
    return result


def off_at(picture: np.ndarray, point: np.ndarray, view: Viewpoint) -> float:
    """Return by how much the best pixel near a place on the box's walls differs from the colour of that place."""
    column, row = map(int, place_of(point, view))
    around = picture[row - 4 : row + 5, column - 4 : column + 5].astype(int)
    return float(np.abs(around - world_color(point / HALF)).max(axis=-1).min())


def test_inside_a_camera_every_direction_is_where_it_was(tmp_path: Path, windows: list[SceneWindow]) -> None:
    """The panoramas are coloured by direction in the world, so a mirrored or turned sphere has other colours."""
    window = window_on(write_output(tmp_path, turned_poses(3), points=0), windows, view="inside:001")
    window.tour.key("k")
    for dx, dy in ((300, 0), (-900, -200)):
        window.tour.drag(dx, dy, window_height=SIZE[1])
        window.update()
        picture = window.picture()
        for x, y in ((450, 300), (200, 250), (700, 400), (450, 120)):
            along = window.tour.state.viewpoint.ray(x + 0.5, y + 0.5, SIZE)[1]
            assert np.abs(seen_at(picture, x, y) - world_color(along)).max() <= 8


def test_the_directions_are_shown_where_the_bar_is_not(tmp_path: Path, windows: list[SceneWindow]) -> None:
    window = window_on(write_output(tmp_path, {}, points=500), windows, view="top")
    _, lowest, _, _ = window.plotter.renderer.axes_widget.GetViewport()
    ends = np.asarray(window.plotter.actors["bar"].mapper.dataset.points, np.float64)
    upper = SIZE[1] * (1 - lowest)
    for x, y in (place_of(point, window.tour.state.viewpoint) for point in ends):
        assert 0 < x < SIZE[0]
        assert upper < y < SIZE[1]


def test_from_outside_a_camera_is_a_window_to_what_lies_behind(tmp_path: Path, windows: list[SceneWindow]) -> None:
    """A sphere shows its far side from within: as one would see it from inside, not mirrored, the right way up."""
    poses = {"a.png": Rigid3.from_center(turned_poses(1, seed=4)["lobby/000.png"].rotation, np.array([0.5, 0.1, 0.3]))}
    window = window_on(write_output(tmp_path, poses, points=0), windows)
    tour = window.tour
    center, radius = tour.centers[0], tour.radius
    view = tour.state.viewpoint
    picture = window.picture()
    x0, y0 = place_of(center, view)
    edge = place_of(center + radius * view.axes[0], view)[0] - x0
    assert edge > 5
    for dx, dy in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
        start, along = view.ray(x0 + dx * edge, y0 + dy * edge, SIZE)
        offset = start - center
        far = -(offset @ along) + np.sqrt((offset @ along) ** 2 - offset @ offset + radius**2)
        expected = world_color(offset + far * along)
        assert np.abs(seen_at(picture, x0 + dx * edge, y0 + dy * edge) - expected).max() <= 16


def test_points_are_drawn_where_they_are_and_walls_open_to_the_eye(tmp_path: Path, windows: list[SceneWindow]) -> None:
    window = window_on(write_output(tmp_path, {}, points=100_000), windows, view="top")
    floor, ceiling = np.array([0.3, 1, 0.2]) * HALF, np.array([0.3, -1, 0.2]) * HALF
    for key, point in (("h", floor), ("x", ceiling)):  # the first changes nothing here
        window.tour.key(key)
        window.update()
        assert off_at(window.picture(), point, window.tour.state.viewpoint) <= 6
    window.tour.key("x")
    window.tour.see("overview")
    window.update()
    view = window.tour.state.viewpoint
    hidden = next(wall for wall in (HALF * [-1, 0, 0], HALF * [1, 0, 0]) if (wall - view.eye) @ -wall > 0)
    assert off_at(window.picture(), hidden, view) > 30
    assert off_at(window.picture(), -hidden, view) <= 6


def test_the_mouse_of_the_window_steps_in_looks_around_and_steps_out(
    tmp_path: Path, windows: list[SceneWindow]
) -> None:
    window = window_on(write_output(tmp_path, turned_poses(4)), windows)
    tour, interactor = window.tour, window.plotter.iren.interactor
    start = window.seen_from()
    nearest = int(np.argmin(np.linalg.norm(tour.centers - start.eye, axis=1)))

    def at(x: float, y: float, *events: str) -> None:
        interactor.SetEventInformation(int(x), SIZE[1] - 1 - int(y), 0, 0, "\0", 0, None)
        for event in events:
            interactor.InvokeEvent(event)

    spot = place_of(tour.centers[nearest], start)
    at(*spot, "MouseMoveEvent")
    assert tour.state.hovered == nearest
    at(*spot, "LeftButtonPressEvent", "LeftButtonReleaseEvent")
    assert tour.state.inside == nearest
    np.testing.assert_allclose(window.plotter.camera.position, tour.centers[nearest], atol=1e-6)
    before = tour.state.viewpoint.axes[2]
    at(100, 590, "LeftButtonPressEvent")
    at(220, 590, "MouseMoveEvent", "LeftButtonReleaseEvent")
    assert tour.state.inside == nearest
    after, up = tour.state.viewpoint.axes[2], tour.scene.up
    level = [along - up * (along @ up) for along in (before, after)]
    turned = np.rad2deg(np.arctan2(np.cross(*level) @ up, level[0] @ level[1]))
    assert turned == pytest.approx(16, abs=1e-6)  # to the left, by a share of the 80° of the window
    angle = tour.state.viewpoint.angle_deg
    at(220, 590, "MouseWheelForwardEvent")
    assert tour.state.viewpoint.angle_deg < angle
    at(220, 590, "RightButtonPressEvent", "RightButtonReleaseEvent")
    assert window.tour.state.inside is None
    np.testing.assert_allclose(window.plotter.camera.position, start.eye, atol=1e-5)
    at(100, 300, "LeftButtonPressEvent")
    at(160, 300, "MouseMoveEvent", "LeftButtonReleaseEvent")  # the trackball turns the scene
    assert np.linalg.norm(tour.state.viewpoint.eye - start.eye) > 0.1
    np.testing.assert_allclose(
        np.linalg.norm(tour.state.viewpoint.eye - start.target), np.linalg.norm(start.eye - start.target), rtol=1e-6
    )


def test_keys_reach_the_tour_and_the_picture(tmp_path: Path, windows: list[SceneWindow]) -> None:
    window = window_on(write_output(tmp_path, turned_poses(4), quality=True), windows)
    interactor = window.plotter.iren.interactor
    pictures = [window.picture()]
    for key in ("c", "h", "l", "t"):
        interactor.SetKeySym(key)
        interactor.InvokeEvent("KeyPressEvent")
        interactor.InvokeEvent("CharEvent")
        pictures.append(window.picture())
    for before, after in pairwise(pictures):
        assert (before != after).any()
    assert window.tour.state.coloring == "confidence"
    assert window.tour.state.viewpoint.height > 0


def test_a_measured_distance_is_drawn(tmp_path: Path, windows: list[SceneWindow]) -> None:
    window = window_on(write_output(tmp_path, {}, points=60_000), windows, view="top")
    window.tour.key("m")
    for x in (300, 600):
        window.tour.click(x, 300, SIZE)
    window.update()
    assert window.tour.distance is not None
    orange = np.abs(window.picture().astype(int) - [0xFF, 0xB4, 0x54]).max(axis=-1) < 12
    columns = np.flatnonzero(orange[295:306].any(axis=0))
    assert columns.min() < 305
    assert columns.max() > 595


def test_the_cloud_is_blended_into_a_panorama_on_demand(tmp_path: Path, windows: list[SceneWindow]) -> None:
    window = window_on(write_output(tmp_path, turned_poses(2), points=60_000), windows, view="inside:000")
    alone = window.picture()
    window.tour.key("b")
    window.update()
    blended = window.picture()
    assert 0.3 < (alone != blended).any(axis=-1).mean() < 1
    window.tour.key("b")
    window.update()
    np.testing.assert_array_equal(window.picture(), alone)


def test_all_points_are_drawn_on_demand(tmp_path: Path, windows: list[SceneWindow]) -> None:
    window = window_on(write_output(tmp_path, {}), windows, budget=500)
    assert window.tour.cloud is not None
    for count in (20_000, 500):
        window.tour.key("d")
        window.update()
        assert len(window.tour.cloud.points) == count


def test_of_very_many_cameras_the_nearest_have_pictures(tmp_path: Path, windows: list[SceneWindow]) -> None:
    poses = turned_poses(3)
    out = write_output(tmp_path, poses, points=0)
    scene = open_scene(out)
    rng = np.random.default_rng(0)
    many = tuple(
        type(scene.cameras[0])(f"{idx}.png", Rigid3.from_center(np.eye(3), rng.uniform(-9, 9, 3)), None, None)
        for idx in range(5000)
    )
    crowd = type(scene)("crowd", None, None, many, "m", scene.up, scene.ahead)
    tour = Tour(crowd, None, box_of(np.zeros((0, 3)), crowd.centers))
    windows.append(SceneWindow(tour, size_wh=SIZE, off_screen=True))
    assert len(windows[-1]._spheres) == TEXTURED
    tour.step_into(4321)
    windows[-1].update()
    distances = np.linalg.norm(tour.centers - tour.centers[4321], axis=1)
    assert set(windows[-1]._spheres) == set(np.argsort(distances)[:TEXTURED].tolist())
    assert windows[-1]._dots.mapper.dataset.n_points == 5000 - TEXTURED


def test_a_lone_mesh_is_shown(tmp_path: Path, windows: list[SceneWindow]) -> None:
    (tmp_path / "mesh.ply").write_text(MESH)
    scene = open_scene(tmp_path / "mesh.ply")
    tour = Tour(scene, None, np.array([[0.0, 0, -0.5], [1, 1, 0.5]]))
    tour.see("front")
    tour.key("x")
    windows.append(SceneWindow(tour, size_wh=SIZE, off_screen=True))
    picture = windows[-1].picture()
    inside = place_of(np.array([0.2, 0.3, 0]), tour.state.viewpoint)
    outside = place_of(np.array([0.8, 0.8, 0]), tour.state.viewpoint)
    assert seen_at(picture, *inside).mean() > 150 > seen_at(picture, *outside).mean()


def test_a_mesh_faces_the_side_that_was_seen_and_can_be_chosen(tmp_path: Path, windows: list[SceneWindow]) -> None:
    """A floor that faces up: red from above, not there from below, behind the cloud's choice of surface."""
    out = write_output(tmp_path, {}, points=5000)
    corners = np.array([[-3, 1.5, -4], [3, 1.5, -4], [3, 1.5, 4], [-3, 1.5, 4]], np.float32)
    red = np.tile(np.array([250, 10, 10], np.uint8), (4, 1))
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    write_ply_mesh(out / "mesh.ply", (corners, red, triangles), file_from_world=z_up_from_world())
    window = window_on(out, windows, view="top")

    def share_of_red() -> float:
        window.update()
        picture = window.picture().astype(int)
        return float(((picture[..., 0] > 200) & (picture[..., 1:].max(axis=-1) < 60)).mean())

    assert share_of_red() == 0  # the cloud
    window.tour.key("s")
    assert share_of_red() > 0.3  # the mesh
    window.tour.key("s")
    assert share_of_red() > 0.1  # both
    above = window.tour.state.viewpoint
    window.tour.moved_to(replace(above, eye=2 * above.target - above.eye, up=above.up))
    window.tour.key("s")
    window.tour.key("s")
    assert share_of_red() == 0  # from below
    window.tour.key("x")
    assert share_of_red() > 0.3


def test_without_a_display_the_remedy_is_named() -> None:
    with pytest.raises(UsageError, match=r"no display .* --screenshot FILE"):
        require_display({}, "linux")
    require_display({"DISPLAY": ":0"}, "linux")
    require_display({}, "darwin")
    require_display({}, "win32")


def test_a_display_that_does_not_answer_is_told_from_one_that_does() -> None:
    with pytest.raises(UsageError, match="does not respond"):
        require_window("vtkEGLRenderWindow")
    require_window("vtkXOpenGLRenderWindow")


def test_without_any_way_to_draw_the_packages_are_named() -> None:
    with pytest.raises(UsageError, match="apt install libegl1"):
        require_drawing({}, "linux", loads=lambda name: False)
    require_drawing({}, "linux", loads=lambda name: "OSMesa" in name)
    require_drawing({"DISPLAY": ":0"}, "linux", loads=lambda name: False)
    require_drawing({}, "darwin", loads=lambda name: False)
