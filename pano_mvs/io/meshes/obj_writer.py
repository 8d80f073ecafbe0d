"""Textured meshes as Wavefront OBJ with a material file (MTL)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.meshes.textured_arrays import TexturedArrays

_LINES_AT_ONCE = 1 << 16
_MATERIAL = "texture"


def write_obj(path: Path, mesh: TexturedArrays, *, material_file: str) -> None:
    """Write a mesh as OBJ: v, vt (with the origin in the lower-left corner, as OBJ has it) and f.

    Args:
        path: the file to write.
        mesh: the mesh.
        material_file: name of the MTL file of `write_mtl`, in the same folder.
    """
    flipped = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], axis=1)
    corners = (mesh.faces + 1).repeat(2, axis=1)  # the texture coordinate has the number of the vertex
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(f"mtllib {material_file}\nusemtl {_MATERIAL}\n")
        stream.writelines(_lines("v %.7g %.7g %.7g\n", mesh.positions))
        stream.writelines(_lines("vt %.7g %.7g\n", flipped))
        stream.writelines(_lines("f %d/%d %d/%d %d/%d\n", corners))


def write_mtl(path: Path, *, texture_file: str) -> None:
    """Write the material of `write_obj`: an image without lighting.

    Args:
        path: the file to write.
        texture_file: name of the image file, in the same folder.
    """
    lines = [f"newmtl {_MATERIAL}", "Ka 1 1 1", "Kd 1 1 1", "Ks 0 0 0", "d 1", "illum 0", f"map_Kd {texture_file}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _lines(form: str, values: NDArray[Any]) -> Iterator[str]:
    for first in range(0, len(values), _LINES_AT_ONCE):
        block = values[first : first + _LINES_AT_ONCE]
        yield (form * len(block)) % tuple(block.ravel().tolist())
