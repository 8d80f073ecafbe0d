"""View a run in a window, or write an image of it, and check that the system can draw."""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, StoreError, UsageError
from pano_mvs.results.run_output import RunOutput
from pano_mvs_viewer.cloud_colors import POINT_BUDGET, color_cloud, drawn_cloud
from pano_mvs_viewer.controller import Tour
from pano_mvs_viewer.shown_scene import ShownScene, open_scene
from pano_mvs_viewer.viewpoint import box_of

_SIZE = re.compile(r"([1-9][0-9]{1,4})[x×]([1-9][0-9]{1,4})")
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")


@dataclass(frozen=True)
class ViewOptions:
    """What a window or an image shows, and how; the options of `pano-mvs view`."""

    images: str | Path | None = None  # folder of the panoramas; None: where the run read them
    screenshot: str | Path | None = None  # image file to write instead of opening a window
    view: str = "overview"  # "overview", "top", "front" or "inside:NAME"
    color: str = "rgb"  # of the cloud, see `COLORINGS`
    surface: str = ""  # "cloud", "mesh" or "both"; empty for the cloud if it exists
    points: int = POINT_BUDGET  # maximum number of points to draw; 0: all
    size: str = "1280x860"  # WIDTHxHEIGHT of the window in pixels
    labels: bool = False  # whether cameras are named
    blended: bool = False  # whether the cloud is shown within a panorama
    backs: bool = False  # whether points and triangles that face away from the viewer are shown
    group: int = 0  # group of poses to show; 0 is the largest
    ranges: bool = False  # whether a camera's ranges are shown inside it instead of its panorama


def view_run(
    run: RunOutput | str | Path, options: ViewOptions | None = None, *, say: Callable[[str], object] = print
) -> NDArray[np.uint8] | None:
    """View a run or a PLY file in a window until it is closed, or write an image of it.

    >>> picture = view_run("out", ViewOptions(screenshot="top.png", view="top"))
    >>> picture.shape
    (860, 1280, 3)

    Args:
        run: the output of a run, its folder, or a .ply file.
        options: what is shown, and how.
        say: is called with each note about what is missing; prints it by default.

    Returns:
        The image, (H, W, 3) uint8 RGB; None if a window was opened.

    Raises:
        InputError: if there is nothing to show, or a file is damaged.
        UsageError: if an option is invalid, or there is no display.
        StoreError: if the image cannot be written.
    """
    options = options or ViewOptions()
    images, screenshot = (None if path is None else Path(path) for path in (options.images, options.screenshot))
    size_wh = _size_wh(options.size)
    if screenshot is not None and screenshot.suffix.lower() not in _SUFFIXES:
        raise UsageError(f"--screenshot {screenshot}: images must end in {', '.join(_SUFFIXES)}")
    path = run.out if isinstance(run, RunOutput) else Path(run)
    scene = open_scene(path, images=images, group=options.group)
    if screenshot is None:
        require_display()
    else:
        require_drawing()
    tour = _tour(scene, options, size_wh)
    from pano_mvs_viewer.window import SceneWindow  # imported on use, because pyvista is slow to import

    if screenshot is not None:
        quiet_vtk()
    window = SceneWindow(tour, size_wh=size_wh, off_screen=screenshot is not None, budget=options.points)
    for note in scene.notes:
        say(note)
    if screenshot is None:
        require_window(window.plotter.render_window.GetClassName())
        window.run()
        return None
    picture = window.picture()
    window.close()
    _write(screenshot, picture)
    return picture


def _tour(scene: ShownScene, options: ViewOptions, size_wh: tuple[int, int]) -> Tour:
    cloud = drawn_cloud(scene.cloud, budget=options.points) if scene.cloud is not None else None
    if cloud is not None:
        color_cloud(cloud, options.color, up=scene.up, unit=scene.unit)  # raises if the colouring is not available
    points = cloud.points if cloud is not None else np.zeros((0, 3), np.float32)
    corners = _mesh_points(scene.mesh) if cloud is None and scene.mesh is not None else None
    box = box_of(points if corners is None else corners, scene.centers)
    tour = Tour(scene, cloud, box, aspect=size_wh[0] / size_wh[1], corners=corners)
    tour.see(options.view)
    # Our meshes face the observed side; the orientation of other meshes is unknown.
    backs = options.backs or (cloud is None and not scene.cameras)
    shown = {"labels": options.labels, "blended": options.blended, "backs": backs, "ranges": options.ranges}
    tour.begin(coloring=options.color, **shown)
    if options.surface:
        if options.surface not in ("cloud", "mesh", "both"):
            raise UsageError(f"--show {options.surface}: must be cloud, mesh or both")
        missing = {"cloud": scene.cloud is None, "mesh": scene.mesh is None}
        absent = [name for name in ("cloud", "mesh") if options.surface in (name, "both") and missing[name]]
        if absent:
            raise UsageError(f"--show {options.surface}: there is no {absent[0]}.ply in {scene.name}")
        tour.begin(surface=options.surface)
    return tour


def _mesh_points(path: Path) -> NDArray[np.float32]:
    """Return the vertices of a mesh, (N, 3) float32."""
    from pano_mvs.io.ply import read_ply_points

    points = read_ply_points(path)
    if not len(points):
        raise InputError(f"{path}: the mesh has no vertices. Export it again")
    return points


def _size_wh(text: str) -> tuple[int, int]:
    found = _SIZE.fullmatch(text.strip())
    if found is None:
        raise UsageError(f"--size {text}: give the width and the height in pixels, such as 1280x860")
    return int(found[1]), int(found[2])


def _write(path: Path, picture: NDArray[np.uint8]) -> None:
    quality = {".webp": cv2.IMWRITE_WEBP_QUALITY}.get(path.suffix.lower(), cv2.IMWRITE_JPEG_QUALITY)
    data = cv2.imencode(path.suffix.lower(), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [quality, 90])[1]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise StoreError(f"--screenshot {path}: cannot be written ({error.strerror}). Choose another place") from error


_DRAWING_LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so")
_REMEDY = "Use --screenshot FILE to write an image without a window"


def require_display(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> None:
    """Raise UsageError if no window can be opened."""
    if platform.startswith("linux") and not environment.get("DISPLAY"):
        raise UsageError(
            f"there is no display (DISPLAY is not set), so no window can be opened. {_REMEDY}, or run "
            "this on a machine with a screen, or over ssh -X"
        )


def require_window(window_class: str) -> None:
    """Raise UsageError if VTK fell back to off-screen rendering, because the display does not respond."""
    if window_class in ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow"):
        raise UsageError(f"the display {os.environ.get('DISPLAY', '')} does not respond. {_REMEDY}")


def require_drawing(
    environment: Mapping[str, str] = os.environ,
    platform: str = sys.platform,
    *,
    loads: Callable[[str], bool] | None = None,
) -> None:
    """Raise UsageError if there is neither a display nor a library for off-screen rendering; VTK would crash."""
    if not platform.startswith("linux") or environment.get("DISPLAY"):
        return
    if not any((loads or _loads)(name) for name in _DRAWING_LIBRARIES):
        raise UsageError(
            "images cannot be rendered: neither EGL nor OSMesa is installed. Install one: for Debian "
            "and Ubuntu `apt install libegl1 libgl1-mesa-dri`"
        )


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def quiet_vtk() -> None:
    """Suppress VTK's message about a missing X server before off-screen rendering."""
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
