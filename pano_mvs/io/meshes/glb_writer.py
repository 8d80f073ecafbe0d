"""Textured meshes as binary glTF 2.0 (Khronos Group, "glTF 2.0 Specification", ISO/IEC 12113:2022)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.meshes.picture_data import MIME_TYPES, TextureFormat
from pano_mvs.io.meshes.textured_arrays import TexturedArrays

_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT32, _ARRAY_BUFFER, _ELEMENT_BUFFER = 5126, 5125, 34962, 34963
_LINEAR, _LINEAR_MIPMAPS, _CLAMP = 9729, 9987, 33071
# The colours of a photograph already contain the light of the place.
_UNLIT = "KHR_materials_unlit"


def write_glb(path: Path, mesh: TexturedArrays, picture: bytes, *, form: TextureFormat) -> None:
    """Write a mesh with its texture as one GLB file, without lighting (KHR_materials_unlit), visible from both sides.

    Args:
        path: the file to write.
        mesh: the mesh, y up.
        picture: bytes of the texture's image file.
        form: format of that file.
    """
    parts = [
        np.ascontiguousarray(mesh.positions, "<f4").tobytes(),
        np.ascontiguousarray(mesh.uv, "<f4").tobytes(),
        np.ascontiguousarray(mesh.faces, "<u4").tobytes(),
        picture,
    ]
    padded = [part + b"\0" * (-len(part) % 4) for part in parts]
    starts = np.cumsum([0, *map(len, padded)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(part)} for start, part in zip(starts, parts, strict=False)
    ]
    for view, target in zip(views, (_ARRAY_BUFFER, _ARRAY_BUFFER, _ELEMENT_BUFFER), strict=False):
        view["target"] = target
    document = _document(mesh, MIME_TYPES[form]) | {"bufferViews": views, "buffers": [{"byteLength": starts[-1]}]}
    head = json.dumps(document, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    with path.open("wb") as stream:
        stream.write(struct.pack("<III", _MAGIC, _VERSION, 12 + 8 + len(head) + 8 + starts[-1]))
        stream.write(struct.pack("<II", len(head), _JSON) + head)
        stream.write(struct.pack("<II", starts[-1], _BINARY))
        stream.writelines(padded)


def _document(mesh: TexturedArrays, mime_type: str) -> dict[str, Any]:
    positions: NDArray[np.float32] = mesh.positions
    return {
        "asset": {"version": "2.0", "generator": "pano_mvs"},
        "extensionsUsed": [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1},
                "doubleSided": True,
                "extensions": {_UNLIT: {}},
            }
        ],
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": [{"bufferView": 3, "mimeType": mime_type}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(positions),
                "type": "VEC3",
                "min": positions.min(axis=0).tolist(),
                "max": positions.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": len(mesh.uv), "type": "VEC2"},
            {"bufferView": 2, "componentType": _UINT32, "count": mesh.faces.size, "type": "SCALAR"},
        ],
    }
