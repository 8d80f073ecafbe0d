"""Textured meshes in binary glTF 2.0 files, as far as `export.mesh_textured` writes them."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.scene import FilePart

_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES: dict[int, np.dtype[Any]] = {5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh with a texture.

    Attributes:
        positions: (V, 3) float32 in the axes of the file.
        uv: (V, 2) float32, from the upper-left corner of the texture.
        faces: (F, 3) int32.
        texture: (H, W, 3) uint8 RGB.
    """

    positions: NDArray[np.float32]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]
    texture: NDArray[np.uint8]


def read_glb(path: Path) -> TexturedMesh:
    """Return the mesh of a GLB file with one primitive and one texture in the file itself.

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
    return TexturedMesh(arrays[0].astype(np.float32), arrays[1].astype(np.float32), faces, texture)


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the description and the binary part of a GLB file."""
    magic, version, length = struct.unpack_from("<III", data)
    if (magic, version, length) != (_MAGIC, 2, len(data)):
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
