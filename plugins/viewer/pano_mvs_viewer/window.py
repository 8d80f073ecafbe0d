"""The window of the viewer, drawn by PyVista from the state of the tour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.points.plan_grid import bar_length, bar_text
from pano_mvs.core.text import plural
from pano_mvs.io.ply import open_ply_points
from pano_mvs_viewer.actors import (
    LARGE_WIDTH,
    SMALL_WIDTH,
    CloudActor,
    Overlay,
    range_panorama,
    rims_actor,
    sphere_actor,
    sphere_picture,
)
from pano_mvs_viewer.cloud_colors import POINT_BUDGET, color_cloud, drawn_cloud
from pano_mvs_viewer.controller import Tour, TourState
from pano_mvs_viewer.viewpoint import Viewpoint, length_text

TEXTURED = 64
"""Maximum number of cameras, the nearest ones, that are spheres with pictures; all others are dots."""

_BACKGROUND, _BACKGROUND_TOP, _INK = "#15181d", "#2b313a", "#e8ebf0"
_ACCENT, _DOTS, _RIM = "#ffb454", "#7fb4ff", "#4da3ff"


class SceneWindow:
    """A plotter with the scene of a tour."""

    def __init__(self, tour: Tour, *, size_wh: tuple[int, int], off_screen: bool, budget: int = POINT_BUDGET) -> None:
        import pyvista

        self.tour, self._budget = tour, budget
        plotter: Any = pyvista.Plotter
        self.plotter: Any = plotter(
            off_screen=off_screen, window_size=list(size_wh), lighting="none", title=f"pano-mvs · {tour.scene.name}"
        )
        self.plotter.set_background(_BACKGROUND, top=_BACKGROUND_TOP)
        self._font = max(7, round(size_wh[1] / 72))
        self._overlay = Overlay(self.plotter, self._font, ink=_INK, paper=_BACKGROUND)
        self._shown: TourState | None = None
        self._cloud: CloudActor | None = None
        self._spheres: dict[int, Any] = {}
        self._surroundings: Any = None
        self._rims: Any = None
        self._dots: Any = None
        self._legend = self._range_legend = ""
        self._add_mesh()
        self._add_cloud()
        self._add_bar()
        # The upper right corner: the scale bar is at the lower edge, and texts are in the other corners.
        self.plotter.add_axes(
            color=_INK, xlabel="x", ylabel="y", zlabel="z", line_width=2, viewport=(0.8, 0.8, 1.0, 1.0)
        )
        self._hands = Hands(tour, seen_from=self.seen_from, update=self.update)
        self.plotter.clear_events_for_key("b")
        self.plotter.iren.style = self._hands.attach(self.plotter.iren.interactor)
        self.update()

    def run(self) -> None:
        """Show the window until it is closed."""
        self.plotter.show(auto_close=False)
        self.plotter.close()

    def picture(self) -> NDArray[np.uint8]:
        """Return an image of the window, (H, W, 3) RGB."""
        image = self.plotter.screenshot(return_img=True)
        return np.asarray(image, np.uint8)[..., :3]

    def close(self) -> None:
        """Free the memory of the window."""
        self.plotter.close()

    def seen_from(self) -> Viewpoint:
        """Return the viewpoint of the window's camera, which the trackball may have moved."""
        camera = self.plotter.camera
        parallel = bool(camera.parallel_projection)
        return replace(
            self.tour.state.viewpoint,
            eye=np.array(camera.position),
            target=np.array(camera.focal_point),
            up=np.array(camera.up),
            angle_deg=float(camera.view_angle),
            height=2 * float(camera.parallel_scale) if parallel else 0.0,
        )

    def update(self) -> None:
        """Show the tour's state."""
        state, before = self.tour.state, self._shown
        self._shown = state
        self.plotter.suppress_rendering = True  # once, at the end
        camera = self.plotter.camera
        camera.position, camera.focal_point = tuple(state.viewpoint.eye), tuple(state.viewpoint.target)
        camera.up, camera.view_angle = tuple(state.viewpoint.up), state.viewpoint.angle_deg
        camera.parallel_projection = bool(state.viewpoint.height)
        if state.viewpoint.height:
            camera.parallel_scale = state.viewpoint.height / 2
        if before is None or before.all_points != state.all_points:
            self._reload_points(state)
        if before is None or (before.inside, before.ranges) != (state.inside, state.ranges):
            self._surround(state.inside, ranges=state.ranges)
        if before is None or before.viewpoint.eye is not state.viewpoint.eye or not _looks_elsewhere(before, state):
            self._show_cloud(state, before)
            self._show_cameras(state, before)
            self._show_picked(state)
            self._show_texts(state)
        self.plotter.suppress_rendering = False
        self.plotter.renderer.ResetCameraClippingRange()
        self.plotter.render()

    def _add_cloud(self) -> None:
        if self.tour.cloud is not None:
            self._cloud = CloudActor(self.tour.cloud)
            self.plotter.add_actor(self._cloud.actor, name="cloud", reset_camera=False)

    def _add_mesh(self) -> None:
        import pyvista

        self._mesh: Any = None
        if self.tour.scene.mesh is not None:
            mesh = pyvista.read(self.tour.scene.mesh)
            mesh.points = open_ply_points(self.tour.scene.mesh).in_world(np.asarray(mesh.points, np.float32))
            colored = "RGB" in mesh.array_names
            self._mesh = self.plotter.add_mesh(
                mesh,
                scalars="RGB" if colored else None,
                rgb=colored,
                color=None if colored else "#b8bcc4",
                name="mesh",
                reset_camera=False,
            )

    def _add_bar(self) -> None:
        """Add a scale bar along the lower front edge of the scene."""
        scene, box = self.tour.scene, self.tour.box
        right = np.cross(scene.ahead, scene.up)
        corners = np.array(np.meshgrid(*box.T)).reshape(3, -1).T
        extent = float(np.ptp(corners @ right))
        if extent <= 0:
            return
        length = bar_length(extent)
        low = [float((corners @ axis).min()) for axis in (right, scene.up, scene.ahead)]
        start = low[0] * right + low[1] * scene.up + (low[2] - 0.03 * extent) * scene.ahead
        ends = np.stack([start, start + length * right])
        self.plotter.add_lines(ends, color=_INK, width=4, name="bar")
        self._overlay.label(ends[1:] + 0.02 * extent * right, [bar_text(length, scene.unit)], "bar label")

    def _reload_points(self, state: TourState) -> None:
        """Read all points of the file, or a sample for display."""
        cloud = self.tour.cloud
        wanted = 0 if state.all_points else self._budget
        if cloud is None or self.tour.scene.cloud is None or (not wanted and len(cloud.points) == cloud.total):
            return
        if wanted and len(cloud.points) <= wanted:
            return
        self.tour.cloud = drawn_cloud(self.tour.scene.cloud, budget=wanted)
        self._add_cloud()
        self._recolor(state)

    def _recolor(self, state: TourState) -> None:
        self._legend = ""
        if self.tour.cloud is None or self._cloud is None:
            return
        coloring = color_cloud(self.tour.cloud, state.coloring, up=self.tour.scene.up, unit=self.tour.scene.unit)
        self._cloud.color(coloring)
        self._legend = coloring.legend

    def _show_cloud(self, state: TourState, before: TourState | None) -> None:
        if before is None or before.coloring != state.coloring:
            self._recolor(state)
        visible = state.inside is None or state.blended
        if self._mesh is not None:
            self._mesh.SetVisibility(visible and state.surface != "cloud")
            self._mesh.prop.culling = "none" if state.backs else "back"
        if self._cloud is not None:
            self._cloud.actor.SetVisibility(visible and state.surface != "mesh")
            if before is None or before.backs != state.backs or before.all_points != state.all_points:
                self._cloud.show_backs(wanted=state.backs)
            self._cloud.size(self._point_size(state))

    def _point_size(self, state: TourState) -> float:
        """Return the size of points in pixels at which surfaces appear closed."""
        count = max(1, len(self.tour.cloud.points) if self.tour.cloud is not None else 1)
        width, height = self.plotter.window_size
        share = 2.0 if state.inside is not None else 1.6
        return float(np.clip(share * np.sqrt(width * height / count), 1.5, 6.0))

    def _surround(self, camera_idx: int | None, *, ranges: bool) -> None:
        """Show the panorama of a camera, or its ranges if there are any, around the viewer, or remove it."""
        self._range_legend = ""
        if self._surroundings is not None:
            self.plotter.remove_actor(self._surroundings, render=False)
            self._surroundings = None
        outside = camera_idx is None
        for name in ("bar", "bar label"):
            if name in self.plotter.actors:
                self.plotter.actors[name].SetVisibility(outside)
        if camera_idx is None:
            return
        camera = self.tour.scene.cameras[camera_idx]
        radius = 2.0 * float(np.linalg.norm(np.ptp(self.tour.box, axis=0)))
        picture = None
        if ranges:
            picture, self._range_legend = range_panorama(camera, self.tour.scene.unit)
        if picture is None:
            picture = sphere_picture(camera, LARGE_WIDTH)
        self._surroundings = sphere_actor(picture, camera.cam_from_world, radius, surrounds=True)
        self.plotter.add_actor(self._surroundings, name="surroundings", reset_camera=False, pickable=False)

    def _show_cameras(self, state: TourState, before: TourState | None) -> None:
        centers = self.tour.centers
        if not len(centers):
            return
        moved = before is None or not np.array_equal(before.viewpoint.eye, state.viewpoint.eye)
        moved = moved or (before is not None and before.inside != state.inside)
        if moved and state.cameras:
            self._texture_nearest(state.viewpoint.eye)
        for idx, actor in self._spheres.items():
            actor.SetVisibility(state.cameras and idx != state.inside)
        for marks in (self._rims, self._dots):
            if marks is not None:
                marks.SetVisibility(state.cameras)
        self.plotter.remove_actor("names", render=False)
        named = [state.hovered] if state.hovered is not None else []
        if state.labels and state.cameras:
            named = [int(idx) for idx in self._nearest(state.viewpoint.eye, 300) if idx != state.inside]
        if named:
            above = centers[named] + 1.4 * self.tour.radius * self.tour.scene.up
            self._overlay.label(above, [self.tour.scene.cameras[idx].label for idx in named], "names")

    def _nearest(self, eye: NDArray[np.float64], count: int) -> NDArray[np.intp]:
        """Return the cameras nearest to the eye."""
        return np.argsort(np.linalg.norm(self.tour.centers - eye, axis=1), kind="stable")[:count]

    def _texture_nearest(self, eye: NDArray[np.float64]) -> None:
        """Draw the nearest cameras as textured spheres, and remove the textures of others."""
        wanted = {int(idx) for idx in self._nearest(eye, TEXTURED)}
        for idx in [idx for idx in self._spheres if idx not in wanted]:
            self.plotter.remove_actor(self._spheres.pop(idx), render=False)
        for idx in sorted(wanted - self._spheres.keys()):
            camera = self.tour.scene.cameras[idx]
            actor = sphere_actor(sphere_picture(camera, SMALL_WIDTH), camera.cam_from_world, self.tour.radius)
            self.plotter.add_actor(actor, name=f"camera {idx}", reset_camera=False)
            self._spheres[idx] = actor
        self._mark(wanted)

    def _mark(self, textured: set[int]) -> None:
        """Draw rims around the spheres, and dots for all other cameras."""
        tour = self.tour
        self.plotter.remove_actor("rims", render=False)
        self.plotter.remove_actor("dots", render=False)
        share = 1.1 if tour.state.inside is None else 1.03
        rimmed = [idx for idx in sorted(textured) if idx != tour.state.inside]
        self._rims = self._dots = None
        if rimmed:
            self._rims = rims_actor(tour.centers[rimmed], share * tour.radius, _RIM)
            self.plotter.add_actor(self._rims, name="rims", reset_camera=False, pickable=False)
        others = np.delete(tour.centers, sorted(textured), axis=0)
        if len(others):
            self._dots = self.plotter.add_points(
                others, color=_DOTS, point_size=0.7 * self._font, name="dots", reset_camera=False, pickable=False
            )

    def _show_picked(self, state: TourState) -> None:
        for name in ("picked", "measured", "distance"):
            self.plotter.remove_actor(name, render=False)
        if not state.picked:
            return
        points = np.array(state.picked)
        self.plotter.add_points(
            points,
            color=_ACCENT,
            point_size=self._font,
            render_points_as_spheres=True,
            name="picked",
            reset_camera=False,
            pickable=False,
        )
        distance = self.tour.distance
        if distance is not None:
            self.plotter.add_lines(points, color=_ACCENT, width=3, name="measured")
            text = length_text(distance, self.tour.scene.unit)
            self._overlay.label(points.mean(axis=0, keepdims=True), [text], "distance", color=_ACCENT)

    def _show_texts(self, state: TourState) -> None:
        scene, cloud = self.tour.scene, self.tour.cloud
        title = scene.name
        if state.inside is not None:
            title = f"inside {scene.cameras[state.inside].label}   (Esc or right click: out)"
        counts = []
        if cloud is not None:
            of = f" of {cloud.total:,}" if len(cloud.points) < cloud.total else ""
            counts.append(f"{len(cloud.points):,}{of} {plural(len(cloud.points), 'point')}")
        if scene.mesh is not None:
            counts.append("mesh" if cloud is None else f"s: {state.surface} shown")
        if scene.cameras:
            counts.append(f"{len(scene.cameras):,} {plural(len(scene.cameras), 'camera')}")
        self._overlay.text([title, *state.message.split("\n")], "upper_left")
        legend = "" if self._range_legend and not state.blended else self._legend
        self._overlay.text([*self._range_legend.split("\n"), legend, "   ".join([*counts, "h: keys"])], "lower_right")
        self._overlay.help(wanted=state.help)


def _looks_elsewhere(before: TourState, state: TourState) -> bool:
    """Return whether only the viewpoint has changed."""
    names = (field.name for field in fields(TourState) if field.name != "viewpoint")
    return all(getattr(before, name) is getattr(state, name) for name in names)


_LEFT, _RIGHT = "LeftButton", "RightButton"


class Hands:
    """Handles the events of one interactor.

    Outside, VTK's trackball rotates and moves the camera; inside a panorama, dragging changes the direction of view.
    """

    def __init__(self, tour: Tour, *, seen_from: Callable[[], Viewpoint], update: Callable[[], None]) -> None:
        self._tour, self._seen_from, self._update = tour, seen_from, update
        self._pressed: dict[str, tuple[int, int]] = {}
        self._last = (0, 0)
        self._interactor: Any = None
        self._style: Any = None

    def attach(self, interactor: Any) -> Any:
        """Handle the events of a VTK interactor, and return its new style."""
        from vtkmodules.vtkInteractionStyle import vtkInteractorStyleTrackballCamera

        self._interactor, self._style = interactor, vtkInteractorStyleTrackballCamera()
        for button in (_LEFT, _RIGHT):
            self._style.AddObserver(f"{button}PressEvent", self._press)
            self._style.AddObserver(f"{button}ReleaseEvent", self._release)
        self._style.AddObserver("MouseMoveEvent", self._move)
        self._style.AddObserver("MouseWheelForwardEvent", self._wheel)
        self._style.AddObserver("MouseWheelBackwardEvent", self._wheel)
        self._style.AddObserver("KeyPressEvent", self._key)
        self._style.AddObserver("CharEvent", lambda _style, _event: None)  # VTK's own keys
        interactor.SetInteractorStyle(self._style)
        return self._style

    @property
    def _inside(self) -> bool:
        return self._tour.state.inside is not None

    @property
    def _size_wh(self) -> tuple[int, int]:
        width, height = self._interactor.GetRenderWindow().GetSize()
        return max(1, width), max(1, height)

    def _place(self) -> tuple[int, int]:
        """Return the position of the pointer from the upper left corner; VTK counts from the lower left."""
        x, y = self._interactor.GetEventPosition()
        return x, self._size_wh[1] - 1 - y

    def _press(self, _style: Any, event: str) -> None:
        button = event.removesuffix("PressEvent")
        self._pressed[button] = self._last = self._place()
        if not self._inside:
            (self._style.OnLeftButtonDown if button == _LEFT else self._style.OnRightButtonDown)()

    def _release(self, _style: Any, event: str) -> None:
        button = event.removesuffix("ReleaseEvent")
        start, here = self._pressed.pop(button, None), self._place()
        if not self._inside:
            (self._style.OnLeftButtonUp if button == _LEFT else self._style.OnRightButtonUp)()
            self._tour.moved_to(self._seen_from())
        # A press and a release within this distance are a click.
        if start is not None and max(abs(start[0] - here[0]), abs(start[1] - here[1])) < 4:
            if button == _LEFT:
                self._tour.click(here[0] + 0.5, here[1] + 0.5, self._size_wh)
            else:
                self._tour.step_out()
        self._update()

    def _move(self, _style: Any, _event: str) -> None:
        here = self._place()
        before, self._last = self._last, here
        if not self._pressed:
            if not self._inside:
                self._tour.moved_to(self._seen_from())
            if self._tour.hover(here[0] + 0.5, here[1] + 0.5, self._size_wh):
                self._update()
        elif self._inside:
            self._tour.drag(here[0] - before[0], here[1] - before[1], window_height=self._size_wh[1])
            self._update()
        else:
            self._style.OnMouseMove()

    def _wheel(self, _style: Any, event: str) -> None:
        forward = event == "MouseWheelForwardEvent"
        if self._inside:
            self._tour.zoom(1 if forward else -1)
            self._update()
        else:
            (self._style.OnMouseWheelForward if forward else self._style.OnMouseWheelBackward)()

    def _key(self, _style: Any, _event: str) -> None:
        key = self._interactor.GetKeySym()
        if key == "q":
            self._interactor.TerminateApp()
            return
        if not self._inside:
            self._tour.moved_to(self._seen_from())
        if self._tour.key(key):
            self._update()
