"""Spheres textured with panoramas, for views from inside and from outside, and their VTK actors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, ray_from_pixel


@dataclass(frozen=True, eq=False)
class SphereMesh:
    """Triangles of a sphere with texture coordinates.

    Attributes:
        vertices: (V, 3) float64 in the world.
        triangles: (T, 3) int64; clockwise as seen from inside.
        texture_uv: (V, 2) float32, u to the right, v upwards from the lower edge of the image.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    texture_uv: NDArray[np.float32]


def panorama_sphere(cam_from_world: Rigid3, radius: float, *, rows: int = 48) -> SphereMesh:
    """Return a sphere around a camera that shows each pixel of its panorama along that pixel's ray.

    Drawn without the triangles that face the viewer, it shows from outside what lies behind it, like a crystal
    ball. In neither case is text mirrored.

    Args:
        cam_from_world: pose.
        radius: in scene units.
        rows: of quadrilaterals from pole to pole, twice as many around.
    """
    columns = 2 * rows
    y, x = np.mgrid[0 : rows + 1, 0 : columns + 1].astype(np.float64)
    rays = ray_from_pixel(np.stack([x, y], axis=-1), (rows, columns)).reshape(-1, 3)
    vertices = cam_from_world.inverse().apply(rays * radius)
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    corners = np.stack([first, first + 1, first + columns + 2, first + columns + 1], axis=-1)
    # Seen from inside, the corners of a quadrilateral run clockwise: from left to right, then down.
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    texture_uv = np.stack([x / columns, 1 - y / rows], axis=-1).reshape(-1, 2).astype(np.float32)
    return SphereMesh(vertices, triangles, texture_uv)


def sphere_actor(picture: NDArray[np.uint8], cam_from_world: Rigid3, radius: float, *, surrounds: bool = False) -> Any:
    """Return the actor of a sphere that shows a panorama, (H, W, 3) RGB, around its camera.

    Args:
        picture: the panorama.
        cam_from_world: pose.
        radius: in scene units.
        surrounds: whether the viewer is inside; otherwise the near half is left out, see `panorama_sphere`.
    """
    import pyvista

    mesh = panorama_sphere(cam_from_world, radius, rows=96 if surrounds else 24)
    faces = np.column_stack([np.full(len(mesh.triangles), 3), mesh.triangles])
    data: Any = pyvista.PolyData(mesh.vertices, faces.ravel())
    data.active_texture_coordinates = mesh.texture_uv
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
