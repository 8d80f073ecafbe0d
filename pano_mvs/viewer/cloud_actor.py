"""VTK actor of a cloud that hides points facing away from the viewer, so that rooms can be seen from outside."""

from __future__ import annotations

from typing import Any

import numpy as np

from pano_mvs.viewer.cloud_colors import Coloring, DrawnCloud

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
    """The actor of a cloud.

    Attributes:
        actor: to be added to a plotter.
    """

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
