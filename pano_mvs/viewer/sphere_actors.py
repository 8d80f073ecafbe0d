"""VTK actors of spheres with panoramas."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.viewer.panorama_sphere import panorama_sphere


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
