"""Actions of the viewer on clicks, drags and keys, independent of any window and tested without one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.text import shortened_list
from pano_mvs.geometry import pixel_from_ray
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.ranges import read_confidence_png, read_range_tiff
from pano_mvs.scene.range_map import confidence_name
from pano_mvs_viewer.cloud_colors import DrawnCloud
from pano_mvs_viewer.shown_scene import ShownCamera, ShownScene
from pano_mvs_viewer.viewpoint import Viewpoint, length_text, looking_along, outer_box, outside_view, sphere_radius


def pixel_readout(camera: ShownCamera, direction_in_world: NDArray[np.float64], unit: str) -> str:
    """Return the pixel of a camera in a direction (3,), with its range and confidence, as text.

    The pixel is that of the range map, as used by `pano-mvs inspect`; without a range map, only angles are returned.
    """
    ray = camera.cam_from_world.rotation @ direction_in_world
    azimuth, elevation = np.rad2deg([np.arctan2(ray[0], ray[2]), np.arcsin(np.clip(-ray[1], -1, 1))])
    angles = f"azimuth {azimuth:z.1f}°, elevation {elevation:z.1f}°"
    if camera.range_file is None:
        return angles
    try:
        ranges = read_range_tiff(camera.range_file)
        confidence = None if camera.confidence_file is None else read_confidence_png(camera.confidence_file)
    except InputError as error:
        return f"{angles}; {error}"
    height, width = ranges.shape
    x, y = pixel_from_ray(ray, (height, width))
    column, row = int(x) % width, min(int(y), height - 1)
    found = float(ranges[row, column])
    said = f"range {length_text(found, unit)}" if np.isfinite(found) else "no range"
    if confidence is not None and confidence.shape == ranges.shape:
        level = int(confidence[row, column])
        said += f", confidence {level} ({confidence_name(level)})"
    return f"pixel {column} {row}: {said}\n{angles}"


@dataclass(frozen=True, eq=False)
class TourState:
    """State of the viewer."""

    viewpoint: Viewpoint
    surface: str = "cloud"  # "cloud", "mesh" or "both"
    coloring: str = "rgb"  # name of the cloud's colouring
    inside: int | None = None  # index of the camera whose panorama surrounds the viewer, or None
    outside: Viewpoint | None = None  # viewpoint to return to from inside
    measuring: bool = False  # whether clicks pick points
    picked: tuple[FloatArray, ...] = ()  # none, one or two points (3,) in the world
    hovered: int | None = None  # index of the camera under the pointer, or None
    labels: bool = False
    cameras: bool = True
    blended: bool = False  # whether the cloud is shown inside a panorama
    ranges: bool = False  # whether a camera's ranges are shown inside it instead of its panorama
    # whether points and triangles that face away from the viewer are shown; hiding them opens rooms to view
    backs: bool = False
    all_points: bool = False  # whether all points of the file are drawn
    help: bool = False
    message: str = ""


@dataclass(eq=False)
class Tour:
    """A scene and the state of its viewer."""

    scene: ShownScene  # cloud, mesh and cameras
    cloud: DrawnCloud | None  # the points that are drawn, or None
    box: FloatArray  # (2, 3) that contains nearly everything
    aspect: float = 1.5  # width of the window as a multiple of its height
    # (N, 3) of the mesh, to measure distances if there is no cloud; None if there is no mesh
    corners: NDArray[np.float32] | None = None
    state: TourState = field(init=False)

    def __post_init__(self) -> None:
        """Start with the overview."""
        self.centers = self.scene.centers
        self.radius = sphere_radius(self.centers, self.box)
        points = self.corners if self.cloud is None else self.cloud.points
        self._outer_box = self.box if points is None else outer_box(points, self.box)
        self.state = TourState(self.from_outside("overview"), "cloud" if self.cloud is not None else "mesh")

    def from_outside(self, name: str) -> Viewpoint:
        """Return the view called "overview", "top" or "front"."""
        # Perspective leaves a margin; a plan or an elevation has to include the ends of the cloud.
        box = self.box if name == "overview" else self._outer_box
        return outside_view(name, box, self.scene.up, ahead=self.scene.ahead, aspect=self.aspect)

    def see(self, view: str) -> None:
        """Go to a view by name: "overview", "top", "front" or "inside:NAME".

        Raises:
            UsageError: if there is no such view or camera.
        """
        kind, _, name = view.partition(":")
        if kind == "inside":
            names = [camera.name for camera in self.scene.cameras]
            matched = match_image_names([name], names)
            if name not in matched:
                shown = shortened_list(names, 6, rest=" …")
                raise UsageError(f"there is no camera {name!r}; there are: {shown or 'none'}")
            found = names.index(matched[name])
            self.step_into(found)
            pose = self.scene.cameras[found].cam_from_world
            self.moved_to(looking_along(pose.center, pose.rotation[2], self.scene.up))
        elif view in ("overview", "top", "front"):
            self._look(self.from_outside(view))
        else:
            raise UsageError(f"there is no view {view!r}; there are overview, top, front and inside:NAME")

    def begin(self, **settings: str | bool) -> None:
        """Set initial values of fields of `TourState`."""
        self.state = replace(self.state, **settings)  # type: ignore[arg-type]  # names of fields

    def step_into(self, camera_idx: int) -> None:
        """Step inside the panorama of a camera, keeping the direction of view."""
        state = self.state
        center = self.centers[camera_idx]
        forward = self.scene.ahead if state.viewpoint.height else state.viewpoint.axes[2]
        if abs(float(forward @ self.scene.up)) > 0.7 and state.inside is None:
            forward = self.scene.ahead  # from above, do not look at the floor
        self.state = replace(
            state,
            inside=camera_idx,
            outside=state.viewpoint if state.inside is None else state.outside,
            viewpoint=looking_along(center, forward, self.scene.up),
            hovered=None,
            message="",
        )

    def step_out(self) -> None:
        """Return to the previous outside view; outside, cancel measuring."""
        state = self.state
        if state.inside is None or state.outside is None:
            self.state = replace(state, measuring=False, picked=(), message="")
            return
        self.state = replace(state, inside=None, outside=None, viewpoint=state.outside, message="")

    def click(self, x: float, y: float, size_wh: tuple[int, int]) -> None:
        """Handle a click: pick a point, step into a camera, or read a pixel."""
        start, direction = self.state.viewpoint.ray(x, y, size_wh)
        if self.state.measuring:
            self._pick(start, direction)
            return
        found = self._camera_at(start, direction)
        if found is not None:
            self.step_into(found)
        elif self.state.inside is not None:
            said = pixel_readout(self.scene.cameras[self.state.inside], direction, self.scene.unit)
            self.state = replace(self.state, message=said)

    def hover(self, x: float, y: float, size_wh: tuple[int, int]) -> bool:
        """Set the camera under the pointer, and return whether it changed."""
        before = self.state.hovered
        self.state = replace(self.state, hovered=self._camera_at(*self.state.viewpoint.ray(x, y, size_wh)))
        return self.state.hovered != before

    def drag(self, dx_px: float, dy_px: float, *, window_height: int) -> None:
        """Look around."""
        viewpoint = self.state.viewpoint.turned(dx_px, dy_px, window_height=window_height)
        self.state = replace(self.state, viewpoint=viewpoint)

    def zoom(self, steps: float) -> None:
        """Decrease the viewing angle, or increase it for negative steps."""
        self.state = replace(self.state, viewpoint=self.state.viewpoint.zoomed(steps))

    def key(self, name: str) -> bool:
        """Handle a key, and return whether it has a function."""
        action = self._keys.get(name)
        if action is not None:
            action()
        return action is not None

    def moved_to(self, viewpoint: Viewpoint) -> None:
        """Set the viewpoint to that of the window, which its own mouse handling may have moved."""
        self.state = replace(self.state, viewpoint=viewpoint)

    @property
    def distance(self) -> float | None:
        """Distance of the two picked points in scene units, or None."""
        if len(self.state.picked) < 2:
            return None
        return float(np.linalg.norm(self.state.picked[1] - self.state.picked[0]))

    @property
    def _keys(self) -> Mapping[str, Callable[[], None]]:
        return {
            "Escape": self.step_out,
            "c": self._next_coloring,
            "s": self._next_surface,
            "m": lambda: self._toggle("measuring"),
            "l": lambda: self._toggle("labels"),
            "k": lambda: self._toggle("cameras"),
            "b": lambda: self._toggle("blended"),
            "r": lambda: self._toggle("ranges"),
            "x": lambda: self._toggle("backs"),
            "d": lambda: self._toggle("all_points"),
            "h": lambda: self._toggle("help"),
            "Right": lambda: self._next_camera(1),
            "Left": lambda: self._next_camera(-1),
            "o": lambda: self._look(self.from_outside("overview")),
            "t": lambda: self._look(self.from_outside("top")),
            "y": lambda: self._look(self.from_outside("front")),
        }

    def _look(self, viewpoint: Viewpoint) -> None:
        self.state = replace(self.state, viewpoint=viewpoint, inside=None, outside=None, message="")

    def _toggle(self, name: str) -> None:
        self.state = replace(self.state, **{name: not getattr(self.state, name)})  # type: ignore[arg-type]  # names of fields
        if name == "measuring":
            message = "measuring: click two points" if self.state.measuring else ""
            self.state = replace(self.state, picked=(), message=message)

    def _next_coloring(self) -> None:
        names = self.cloud.colorings if self.cloud is not None else ()
        if names:
            place = names.index(self.state.coloring) if self.state.coloring in names else -1
            self.state = replace(self.state, coloring=names[(place + 1) % len(names)])

    def _next_surface(self) -> None:
        if self.cloud is not None and self.scene.mesh is not None:
            following = {"cloud": "mesh", "mesh": "both", "both": "cloud"}
            self.state = replace(self.state, surface=following[self.state.surface])

    def _next_camera(self, step: int) -> None:
        if self.scene.cameras:
            here = self.state.inside if self.state.inside is not None else (-1 if step > 0 else 0)
            self.step_into((here + step) % len(self.scene.cameras))

    def _camera_at(self, start: FloatArray, direction: FloatArray) -> int | None:
        if not self.state.cameras or not len(self.centers):
            return None
        found = camera_under(start, direction, self.centers, radius=self.radius)
        return found if found != self.state.inside else None

    def _pick(self, start: FloatArray, direction: FloatArray) -> None:
        points = self.cloud.points if self.cloud is not None else self.corners
        if points is None:
            self.state = replace(self.state, message="there is no cloud to measure")
            return
        height = self.state.viewpoint.height
        normals = None if self.state.backs or self.cloud is None else self.cloud.normals
        found = point_under(start, direction, points, normals=normals, parallel_reach=0.006 * height)
        if found is None:
            self.state = replace(self.state, message="no point there: click on the cloud")
            return
        point = points[found].astype(np.float64)
        picked = (*self.state.picked, point) if len(self.state.picked) < 2 else (point,)
        self.state = replace(self.state, picked=picked)
        distance = self.distance
        said = "click the second point" if distance is None else length_text(distance, self.scene.unit)
        if distance is not None and self.scene.unit != "m":
            said += f" from {_place_text(picked[0])} to {_place_text(picked[1])}"
        self.state = replace(self.state, message=said)


def _place_text(point: FloatArray) -> str:
    """Return coordinates as `pano-mvs scale` takes them."""
    return ",".join(f"{value:z.4g}" for value in point)


# A ray hits a point within this angle: half the width of a click at a usual field of view.
_REACH_RAD = np.deg2rad(0.4)


def camera_under(start: FloatArray, direction: FloatArray, centers: FloatArray, *, radius: float) -> int | None:
    """Return the nearest camera whose sphere a ray intersects, or None.

    Args:
        start: (3,) origin of the ray.
        direction: (3,) unit.
        centers: (N, 3) of the spheres.
        radius: of each of them.
    """
    along, aside = _along_and_aside(start, direction, centers)
    met = (aside <= radius) & (along > radius)
    if not met.any():
        return None
    candidates = np.flatnonzero(met)
    return int(candidates[np.argmin(along[candidates])])


def point_under(
    start: FloatArray,
    direction: FloatArray,
    points: NDArray[np.float32],
    *,
    normals: NDArray[np.float32] | None = None,
    parallel_reach: float = 0.0,
) -> int | None:
    """Return the nearest point close to a ray, or None.

    Args:
        start: (3,) origin of the ray.
        direction: (3,) unit.
        points: (N, 3).
        normals: (N, 3); points that face away are ignored, since they are not drawn. None: use all points.
        parallel_reach: maximum distance from the ray, scene units; 0: it grows with the distance from the viewer.
    """
    if not len(points):
        return None
    along, aside = _along_and_aside(start, direction, points)
    near = (along > 0) & (aside < (parallel_reach or np.tan(_REACH_RAD) * along))
    candidates = np.flatnonzero(near)
    if normals is not None:
        seen_along = direction if parallel_reach else points[candidates] - start
        candidates = candidates[np.sum(normals[candidates] * seen_along, axis=-1) <= 0]
    if not len(candidates):
        return None
    first = float(along[candidates].min())
    # Of the foremost surface, the point closest to the ray.
    foremost = candidates[along[candidates] <= first * (1 + 4 * np.tan(_REACH_RAD))]
    return int(foremost[np.argmin(aside[foremost])])


def _along_and_aside(
    start: FloatArray, direction: FloatArray, points: NDArray[np.floating]
) -> tuple[FloatArray, FloatArray]:
    """Return the distance of each point along a ray and from it, (N,) each."""
    offsets = np.asarray(points, np.float64) - start
    along = offsets @ direction
    aside = np.sqrt(np.maximum(np.einsum("ni,ni->n", offsets, offsets) - along**2, 0))
    return along, aside
