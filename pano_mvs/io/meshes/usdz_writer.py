"""Textured meshes as USDZ (Pixar, "USDZ File Format Specification"), which phones and macOS show without a program.

A USDZ is a ZIP archive without compression in which the data of every file begin at a multiple of 64 bytes; its first
file is the scene. Texture coordinates of USD have their origin in the lower-left corner.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.meshes.picture_data import SUFFIXES, TextureFormat
from pano_mvs.io.meshes.textured_arrays import TexturedArrays

_ALIGNMENT, _LOCAL_HEADER, _EXTRA_HEADER = 64, 30, 4
_SCENE = """#usda 1.0
(
    defaultPrim = "mesh"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "mesh" (
    kind = "component"
)
{{
    def Mesh "surface" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {{
        uniform bool doubleSided = 1
        float3[] extent = [{extent}]
        int[] faceVertexCounts = [{counts}]
        int[] faceVertexIndices = [{indices}]
        rel material:binding = </mesh/material>
        point3f[] points = [{points}]
        texCoord2f[] primvars:st = [{coordinates}] (
            interpolation = "vertex"
        )
        uniform token subdivisionScheme = "none"
    }}

    def Material "material"
    {{
        token outputs:surface.connect = </mesh/material/shader.outputs:surface>

        def Shader "shader"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0, 0, 0)
            color3f inputs:emissiveColor.connect = </mesh/material/texture.outputs:rgb>
            float inputs:roughness = 1
            token outputs:surface
        }}

        def Shader "texture"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{texture}@
            token inputs:sourceColorSpace = "sRGB"
            float2 inputs:st.connect = </mesh/material/coordinates.outputs:result>
            token inputs:wrapS = "clamp"
            token inputs:wrapT = "clamp"
            float3 outputs:rgb
        }}

        def Shader "coordinates"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
    }}
}}
"""


def write_usdz(path: Path, mesh: TexturedArrays, picture: bytes, *, form: TextureFormat) -> None:
    """Write a mesh with its texture as one USDZ file; its colours need no light (they are emitted).

    Args:
        path: the file to write.
        mesh: the mesh, y up.
        picture: bytes of the texture's image file.
        form: format of that file.
    """
    texture = f"texture{SUFFIXES[form]}"
    flipped = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], axis=1)
    scene = _SCENE.format(
        extent=_tuples(np.stack([mesh.positions.min(axis=0), mesh.positions.max(axis=0)])),
        counts=", ".join(["3"] * len(mesh.faces)),
        indices=", ".join(map(str, mesh.faces.ravel().tolist())),
        points=_tuples(mesh.positions),
        coordinates=_tuples(flipped),
        texture=texture,
    )
    with path.open("wb") as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, data in (("mesh.usda", scene.encode()), (texture, picture)):
            entry = zipfile.ZipInfo(name)  # of 1980: the same mesh gives the same bytes
            data_at = stream.tell() + _LOCAL_HEADER + len(name) + _EXTRA_HEADER
            padding = -data_at % _ALIGNMENT
            entry.extra = b"\x86\x19" + padding.to_bytes(2, "little") + bytes(padding)
            archive.writestr(entry, data)


def _tuples(values: NDArray[np.float32]) -> str:
    form = f"({', '.join(['%.9g'] * values.shape[1])})"
    return ", ".join([form] * len(values)) % tuple(values.ravel().tolist())
