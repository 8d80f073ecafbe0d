"""Textured meshes as GLB, OBJ and USDZ files."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.scene import FilePart


class TexturedArrays(NamedTuple):
    """A mesh with positions in a texture."""

    positions: NDArray[np.float32]  # (N, 3) float32 in the axes of the file
    uv: NDArray[np.float32]  # (N, 2) float32, (0, 0) the upper-left corner of the texture
    faces: NDArray[np.int32]  # (F, 3) int32, counter-clockwise as seen from outside


TextureFormat = Literal["jpeg", "png"]

SUFFIXES: Final[dict[TextureFormat, str]] = {"jpeg": ".jpg", "png": ".png"}
MIME_TYPES: Final[dict[TextureFormat, str]] = {"jpeg": "image/jpeg", "png": "image/png"}


def encoded_texture(texture: NDArray[np.uint8], form: TextureFormat, *, quality: int) -> bytes:
    """Return a texture (H, W, 3) RGB as the bytes of an image file.

    Raises:
        UsageError: if OpenCV cannot write it, for example because it is larger than 65535 pixels.
    """
    options = [cv2.IMWRITE_PNG_COMPRESSION, 6]
    if form == "jpeg":
        options = [
            *(cv2.IMWRITE_JPEG_QUALITY, quality),
            *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
        ]
    done, data = cv2.imencode(SUFFIXES[form], cv2.cvtColor(texture, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise UsageError(f"a texture of {texture.shape[1]}×{texture.shape[0]} px cannot be written as {form}")
    return data.tobytes()


_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
FLOAT, _UINT32, ARRAY_BUFFER, _ELEMENT_BUFFER = 5126, 5125, 34962, 34963
_LINEAR, _LINEAR_MIPMAPS, _CLAMP = 9729, 9987, 33071
# The colours of a photograph already contain the light of the place.
_UNLIT = "KHR_materials_unlit"


def write_glb(path: Path, mesh: TexturedArrays, picture: bytes, *, form: TextureFormat) -> None:
    """Write a mesh, y up, with its texture as one GLB file, without lighting and visible from both sides."""
    parts = [
        np.ascontiguousarray(mesh.positions, "<f4").tobytes(),
        np.ascontiguousarray(mesh.uv, "<f4").tobytes(),
        np.ascontiguousarray(mesh.faces, "<u4").tobytes(),
        picture,
    ]
    views = [{"target": target} for target in (ARRAY_BUFFER, ARRAY_BUFFER, _ELEMENT_BUFFER)] + [{}]
    shading = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1}
    document = unlit_document(
        {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0},
        {"pbrMetallicRoughness": shading, "doubleSided": True},
        mesh.positions,
        {"componentType": FLOAT, "count": len(mesh.uv), "type": "VEC2"},
        {"componentType": _UINT32, "count": mesh.faces.size, "type": "SCALAR"},
        textures=[{"sampler": 0, "source": 0}],
        samplers=[{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        images=[{"bufferView": 3, "mimeType": MIME_TYPES[form]}],
    )
    write_glb_parts(path, document, parts, views=views)


def write_glb_parts(
    path: Path, document: dict[str, Any], parts: Sequence[bytes], *, views: Sequence[dict[str, int]]
) -> None:
    """Write a glTF document with its binary parts as one GLB file; part n is buffer view n.

    Args:
        document: the document without `buffers` and `bufferViews`.
        parts: the contents of the buffer views.
        views: further properties of each buffer view, such as its target.
    """
    padded = [part + b"\0" * (-len(part) % 4) for part in parts]
    starts = np.cumsum([0, *map(len, padded)]).tolist()
    placed = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(part), **more}
        for start, part, more in zip(starts, parts, views, strict=False)
    ]
    whole = document | {"bufferViews": placed, "buffers": [{"byteLength": starts[-1]}]}
    head = json.dumps(whole, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    with path.open("wb") as stream:
        stream.write(struct.pack("<III", _MAGIC, _VERSION, 12 + 8 + len(head) + 8 + starts[-1]))
        stream.write(struct.pack("<II", len(head), _JSON) + head)
        stream.write(struct.pack("<II", starts[-1], _BINARY))
        stream.writelines(padded)


def unlit_document(
    primitive: dict[str, Any],
    material: dict[str, Any],
    positions: NDArray[np.float32],
    *others: dict[str, Any],
    **textures: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return a glTF document of a primitive without lighting; accessor n is buffer view n, the first its positions."""
    first = {"componentType": FLOAT, "count": len(positions), "type": "VEC3"}
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    return {
        "asset": {"version": "2.0", "generator": "pano_mvs"},
        "extensionsUsed": [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material | {"extensions": {_UNLIT: {}}}],
        **textures,
        "accessors": [{"bufferView": view, **accessor} for view, accessor in enumerate((first | bounds, *others))],
    }


_TYPES: dict[int, np.dtype[Any]] = {5123: np.dtype("<u2"), _UINT32: np.dtype("<u4"), FLOAT: np.dtype("<f4")}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def read_glb(path: Path) -> tuple[TexturedArrays, NDArray[np.uint8]]:
    """Return the mesh and the texture, (H, W, 3) RGB, of a GLB file as `write_glb` writes it.

    Raises:
        InputError: if the file cannot be read or has another layout.
    """
    data = FilePart(path).read_bytes()
    try:
        document, binary = _chunks(data)
        (primitive,) = document["meshes"][0]["primitives"]
        arrays = [
            _accessor(document, binary, number)
            for number in (
                primitive["attributes"]["POSITION"],
                primitive["attributes"]["TEXCOORD_0"],
                primitive["indices"],
            )
        ]
        material = document["materials"][primitive["material"]]["pbrMetallicRoughness"]["baseColorTexture"]
        image = document["images"][document["textures"][material["index"]]["source"]]
        encoded = np.frombuffer(_view(document, binary, image["bufferView"]), np.uint8)
        picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        faces = arrays[2].reshape(-1, 3).astype(np.int32)
        fits = len(arrays[0]) == len(arrays[1]) and (not faces.size or int(faces.max()) < len(arrays[0]))
    except (ValueError, KeyError, IndexError, TypeError, struct.error, cv2.error) as error:
        raise InputError(
            f"{path}: not a textured mesh of pano-mvs in GLB ({error!r}). Run the workflow again"
        ) from error
    if picture is None or not fits:
        raise InputError(f"{path}: its texture or its triangles are damaged. Run the workflow again")
    texture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
    return TexturedArrays(arrays[0].astype(np.float32), arrays[1].astype(np.float32), faces), texture


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the description and the binary part of a GLB file."""
    magic, version, length = struct.unpack_from("<III", data)
    if (magic, version, length) != (_MAGIC, _VERSION, len(data)):
        raise ValueError("its header is not that of a complete GLB file, version 2")
    chunks: dict[int, bytes] = {}
    offset = 12
    while offset < len(data):
        size, kind = struct.unpack_from("<II", data, offset)
        chunks[kind] = data[offset + 8 : offset + 8 + size]
        offset += 8 + size
    document: dict[str, Any] = json.loads(chunks[_JSON])
    return document, chunks[_BINARY]


def _view(document: dict[str, Any], binary: bytes, number: int) -> bytes:
    view = document["bufferViews"][number]
    start = view.get("byteOffset", 0)
    if view.get("byteStride"):
        raise ValueError("interleaved arrays")
    return binary[start : start + view["byteLength"]]


def _accessor(document: dict[str, Any], binary: bytes, number: int) -> NDArray[Any]:
    accessor = document["accessors"][number]
    width = _WIDTHS[accessor["type"]]
    values = np.frombuffer(
        _view(document, binary, accessor["bufferView"]),
        _TYPES[accessor["componentType"]],
        accessor["count"] * width,
        accessor.get("byteOffset", 0),
    )
    return values.reshape(-1, width) if width > 1 else values


_LINES_AT_ONCE = 1 << 16
_MATERIAL = "texture"


def write_obj(path: Path, mesh: TexturedArrays, *, material_file: str) -> None:
    """Write a mesh as OBJ: v, vt (with the origin in the lower-left corner, as OBJ has it) and f."""
    flipped = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], axis=1)
    corners = (mesh.faces + 1).repeat(2, axis=1)  # the texture coordinate has the number of the vertex
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(f"mtllib {material_file}\nusemtl {_MATERIAL}\n")
        stream.writelines(_lines("v %.7g %.7g %.7g\n", mesh.positions))
        stream.writelines(_lines("vt %.7g %.7g\n", flipped))
        stream.writelines(_lines("f %d/%d %d/%d %d/%d\n", corners))


def write_mtl(path: Path, *, texture_file: str) -> None:
    """Write the material of `write_obj`: an image without lighting."""
    lines = [f"newmtl {_MATERIAL}", "Ka 1 1 1", "Kd 1 1 1", "Ks 0 0 0", "d 1", "illum 0", f"map_Kd {texture_file}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _lines(form: str, values: NDArray[Any]) -> Iterator[str]:
    for first in range(0, len(values), _LINES_AT_ONCE):
        block = values[first : first + _LINES_AT_ONCE]
        yield (form * len(block)) % tuple(block.ravel().tolist())


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
    """Write a mesh with its texture as one USDZ file; its colours need no light (they are emitted)."""
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
