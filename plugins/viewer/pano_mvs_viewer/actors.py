"""VTK actor of a cloud that hides points facing away from the viewer, so that rooms can be seen from outside."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import narrowed
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, ray_from_pixel
from pano_mvs.io.images.captures import panorama_in
from pano_mvs.io.images.preview import MARKS, color_mapped, mark_unconfirmed, range_limits, unconfirmed_classes
from pano_mvs.io.ranges import read_confidence_png, read_range_tiff
from pano_mvs.scene.image_file import decode_image
from pano_mvs_viewer.cloud_colors import Coloring, DrawnCloud
from pano_mvs_viewer.shown_scene import ShownCamera
from pano_mvs_viewer.viewpoint import length_text

# The normals of the points are passed to the graphics processor with their positions.
_DECLARE, _MOVE = "//VTK::PositionVC::Dec", "//VTK::PositionVC::Impl"
_DECLARED = f"""{_DECLARE}
in vec3 facingMC;
"""
# A point that faces away is moved out of the image. The eye is the origin of the central line of sight;
# in parallel projection it is at infinity, and w is 0.
_MOVED = f"""{_MOVE}
vec4 eyeMC = inverse(MCDCMatrix) * vec4(0.0, 0.0, -1.0, 0.0);
vec3 seenMC = vertexMC.xyz * eyeMC.w - eyeMC.xyz;
float sideMC = abs(eyeMC.w) > 1e-6 && eyeMC.w < 0.0 ? -1.0 : 1.0;
if (sideMC * dot(facingMC, seenMC) > 0.0) {{ gl_Position = vec4(2.0, 2.0, 2.0, 1.0); }}
"""


class CloudActor:
    """The actor of a cloud."""

    def __init__(self, cloud: DrawnCloud) -> None:
        import pyvista
        from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper

        self._data = pyvista.PolyData(np.ascontiguousarray(cloud.points))
        self._data["rgb"] = np.full((len(cloud.points), 3), 200, np.uint8)
        mapper: Any = vtkPolyDataMapper()
        mapper.SetInputData(self._data)
        mapper.SetScalarModeToUsePointFieldData()
        mapper.SelectColorArray("rgb")
        mapper.SetColorModeToDirectScalars()
        self._has_normals = cloud.normals is not None
        if cloud.normals is not None:
            self._data["outwards"] = np.ascontiguousarray(cloud.normals)
            mapper.MapDataArrayToVertexAttribute("facingMC", "outwards", 0, -1)
        self.actor: Any = vtkActor()
        self.actor.SetMapper(mapper)
        self.actor.GetProperty().LightingOff()
        self.show_backs(wanted=False)

    def color(self, coloring: Coloring) -> None:
        """Set the colours of the points."""
        self._data["rgb"] = coloring.colors_rgb
        self._data.Modified()

    def show_backs(self, *, wanted: bool) -> None:
        """Show or hide points that face away from the viewer; points without normals are always shown."""
        shader = self.actor.GetShaderProperty()
        shader.ClearAllVertexShaderReplacements()
        if self._has_normals:
            shader.AddVertexShaderReplacement(_DECLARE, True, _DECLARED, False)
            if not wanted:
                shader.AddVertexShaderReplacement(_MOVE, True, _MOVED, False)

    def size(self, pixels: float) -> None:
        """Set the size of the points."""
        self.actor.GetProperty().SetPointSize(pixels)


def sphere_actor(picture: NDArray[np.uint8], cam_from_world: Rigid3, radius: float, *, surrounds: bool = False) -> Any:
    """Return the actor of a sphere that shows each pixel of a panorama, (H, W, 3) RGB, along that pixel's ray.

    Drawn without the triangles that face the viewer, it shows from outside what lies behind it, like a crystal ball. In
    neither case is text mirrored.
    """
    import pyvista

    rows = 96 if surrounds else 24
    columns = 2 * rows
    y, x = np.mgrid[0 : rows + 1, 0 : columns + 1].astype(np.float64)
    rays = ray_from_pixel(np.stack([x, y], axis=-1), (rows, columns)).reshape(-1, 3)
    vertices = cam_from_world.inverse().apply(rays * radius)
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    corners = np.stack([first, first + 1, first + columns + 2, first + columns + 1], axis=-1)
    # Seen from inside, the corners of a quadrilateral run clockwise: from left to right, then down.
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    faces = np.column_stack([np.full(len(triangles), 3), triangles])
    data: Any = pyvista.PolyData(vertices, faces.ravel())
    data.active_texture_coordinates = np.stack([x / columns, 1 - y / rows], axis=-1).reshape(-1, 2).astype(np.float32)
    as_texture: Any = pyvista.numpy_to_texture  # has no types
    texture = as_texture(np.ascontiguousarray(picture))
    texture.SetInterpolate(True)
    actor = _actor(data)
    actor.SetTexture(texture)
    if not surrounds:
        actor.GetProperty().FrontfaceCullingOn()
    return actor


def rims_actor(centers: NDArray[np.float64], radius: float, color: str) -> Any:
    """Return the actor of rims around spheres, (N, 3), which separate them from the background.

    The far half of larger spheres of this radius is drawn; the part that extends beyond the spheres is the rim.
    """
    import pyvista

    ball: Any = pyvista.Sphere(radius=radius, theta_resolution=32, phi_resolution=24)
    data: Any = pyvista.PolyData(centers).glyph(geom=ball, scale=False, orient=False)
    actor = _actor(data)
    actor.GetProperty().SetColor(*pyvista.Color(color).float_rgb)
    actor.GetProperty().FrontfaceCullingOn()
    return actor


def _actor(data: Any) -> Any:
    from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper

    mapper: Any = vtkPolyDataMapper()
    mapper.SetInputData(data)
    mapper.ScalarVisibilityOff()
    actor: Any = vtkActor()
    actor.SetMapper(mapper)
    actor.GetProperty().LightingOff()
    return actor


# At most this wide, so that stripes are as wide as in previews relative to what they mark.
_WIDTH = 2048


def range_panorama(camera: ShownCamera, unit: str) -> tuple[NDArray[np.uint8] | None, str]:
    """Return the ranges of a camera as colours, (H, W, 3) RGB, and their legend.

    Weak ranges are pale, filled ones striped and panes chequered (`mark_unconfirmed`); pixels without a range are
    grey. Without readable ranges, the picture is None and the legend is the reason.
    """
    if camera.range_file is None:
        return None, "no ranges of this camera: the workflow has no export.ranges, or the run did not reach it"
    try:
        ranges = narrowed(read_range_tiff(camera.range_file), _WIDTH)
        confidence = (
            None if camera.confidence_file is None else narrowed(read_confidence_png(camera.confidence_file), _WIDTH)
        )
    except InputError as error:
        return None, str(error)
    near, far = range_limits(ranges)
    colors = color_mapped(ranges, near, far)
    parts = [f"ranges: red {length_text(near, unit)} to blue {length_text(far, unit)}"]
    if confidence is not None and confidence.shape == ranges.shape:
        colors = mark_unconfirmed(colors, confidence)
        parts += [MARKS[name] for name in unconfirmed_classes(confidence)]
    if not np.isfinite(ranges).all():
        parts.append("grey: no range")
    return colors, "\n".join(parts)


_KEYS = (
    ("left drag", "turn"),
    ("wheel, right drag", "nearer, farther"),
    ("click a camera", "step inside"),
    ("click elsewhere", "inside: pixel and range"),
    ("Esc, right click", "step out"),
    ("left, right", "next camera"),
    ("o, t, y", "overview, top, front"),
    ("m", "measure: click two points"),
    ("c", "colours of the cloud"),
    ("s", "cloud, mesh, or both"),
    ("x", "what faces away from you"),
    ("b", "cloud within the panorama"),
    ("r", "inside: ranges, unconfirmed ones pale"),
    ("d", "all points"),
    ("l, k", "names, cameras"),
    ("h, q", "this help, quit"),
)
_HELP = "\n".join(f" {keys:<18} {what} " for keys, what in _KEYS)
# Position as a share of the window from the lower left corner, and the edges of the text that are placed there.
_PLACES = {
    "upper_left": (0.008, 0.988, "left", "top"),
    "lower_right": (0.992, 0.012, "right", "bottom"),
    "help": (0.012, 0.9, "left", "top"),
}


class Overlay:
    """Writes text on a plotter, replacing earlier text with the same name."""

    def __init__(self, plotter: Any, font: int, *, ink: str, paper: str) -> None:
        self._plotter, self._font, self._ink, self._paper = plotter, font, ink, paper

    def text(self, lines: list[str], corner: str) -> None:
        """Write lines, except empty ones, into the corner "upper_left" or "lower_right"."""
        shown = "\n".join(f" {line} " for line in lines if line)
        self._panel(shown, corner, font="arial", size=0.8)

    def label(self, points: NDArray[np.float64], texts: list[str], name: str, *, color: str = "") -> None:
        """Write a text at each point (N, 3) of the scene."""
        self._plotter.add_point_labels(
            points,
            texts,
            name=name,
            font_size=round(1.5 * self._font),
            text_color=color or self._ink,
            shape="rounded_rect",
            shape_color=self._paper,
            shape_opacity=0.7,
            margin=4,
            always_visible=True,
            show_points=False,
            reset_camera=False,
            render=False,
            pickable=False,
        )

    def help(self, *, wanted: bool) -> None:
        """Show or hide the help."""
        self._panel(_HELP if wanted else "", "help", font="courier", size=0.7)

    def _panel(self, text: str, name: str, *, font: str, size: float) -> None:
        self._plotter.remove_actor(name, render=False)
        if not text:
            return
        x, y, across, upright = _PLACES[name]
        actor = self._plotter.add_text(
            text,
            position=(x, y),
            viewport=True,
            name=name,
            font=font,
            color=self._ink,
            font_size=size * self._font,
            render=False,
        )
        actor.prop.justification_horizontal, actor.prop.justification_vertical = across, upright
        actor.prop.background_color, actor.prop.background_opacity = self._paper, 0.75


SMALL_WIDTH, LARGE_WIDTH = 512, 4096


def sphere_picture(camera: ShownCamera, width: int) -> NDArray[np.uint8]:
    """Return a camera's panorama, (H, W, 3) RGB, at most `width` wide; for small sizes, from the preview.

    A damaged or missing image is replaced by a uniform one, so that the rest can be viewed.
    """
    files = (camera.preview, camera.picture) if width <= SMALL_WIDTH else (camera.picture, camera.preview)
    for path in files:
        if path is None:
            continue
        try:
            if path == camera.preview:
                shown = decode_image(path)
                picture = shown[: shown.shape[1] // 2]
            else:
                picture = panorama_in(path).load_unmasked()
        except InputError:
            continue
        if picture.shape[1] <= width:
            return np.ascontiguousarray(picture)
        size = width, max(1, round(picture.shape[0] * width / picture.shape[1]))
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    # Shown without an image: a uniform ball, lighter at the top, which shows the up direction.
    rows = np.linspace((150, 160, 175), (90, 95, 105), 64)[:, None]
    return np.ascontiguousarray(np.broadcast_to(rows, (64, 128, 3)).astype(np.uint8))
