"""Point clouds as binary PLY files."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError
from pano_mvs.io.clouds.ply_frame import frame_comments, stated_rotation, turned, without_comments
from pano_mvs.io.clouds.thinning import SelectedPoints, chunks
from pano_mvs.scene import FilePart, PointCloud

_PLAIN = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("nx", "<f4"),
        ("ny", "<f4"),
        ("nz", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
    ]
)
_QUALITY = [("views", "u1"), ("confidence", "u1")]
_UNCERTAINTY = [("uncertainty", "<f4")]
_LAYOUTS = [np.dtype([*_PLAIN.descr, *more]) for more in ([], _QUALITY, _UNCERTAINTY, [*_QUALITY, *_UNCERTAINTY])]
_PLY_TYPES = {"f": "float", "u": "uchar"}


def write_ply(
    path: Path,
    cloud: PointCloud,
    *,
    quality: bool = False,
    uncertainty: bool = False,
    kept: SelectedPoints | None = None,
    file_from_world: FloatArray | None = None,
) -> None:
    """Write a cloud as binary little-endian PLY: x y z nx ny nz (float), red green blue (uchar).

    The cloud is written in chunks, so that memory-mapped arrays need not fit in memory.

    Args:
        path: the file to write.
        cloud: the points.
        quality: also write `views`, the number of views that agree on the point, and `confidence` (uchar).
        uncertainty: also write `uncertainty`, the standard deviation of the position in scene units (float); NaN if
            unknown.
        kept: the points to write; all by default.
        file_from_world: rotation (3, 3) that is applied to points and normals and stated in the header, so that
            `read_ply` can undo it; None writes coordinates of the world.
    """
    layout = _LAYOUTS[quality + 2 * uncertainty]
    with path.open("wb") as stream:
        stream.write(_header(len(cloud) if kept is None else kept.count, layout, frame_comments(file_from_world)))
        for chunk in chunks(len(cloud)):
            written = _vertices(cloud, chunk, layout, file_from_world=file_from_world)
            stream.write((written if kept is None else written[kept.within(chunk)]).tobytes())


def write_ply_parts(
    path: Path,
    parts: Iterable[PointCloud],
    *,
    quality: bool = False,
    uncertainty: bool = False,
    file_from_world: FloatArray | None = None,
) -> int:
    """Write clouds one after the other as one PLY file, and return the number of points; see `write_ply`.

    Only one part is in memory at a time. The vertices are written beside the file first, since its header states their
    number.
    """
    layout, count = _LAYOUTS[quality + 2 * uncertainty], 0
    with tempfile.TemporaryFile(dir=path.parent) as body:
        for part in parts:
            body.write(_vertices(part, slice(0, len(part)), layout, file_from_world=file_from_world).tobytes())
            count += len(part)
        body.seek(0)
        with path.open("wb") as stream:
            stream.write(_header(count, layout, frame_comments(file_from_world)))
            shutil.copyfileobj(body, stream, 1 << 20)
    return count


def _vertices(
    cloud: PointCloud, chunk: slice, layout: np.dtype[np.void], *, file_from_world: FloatArray | None
) -> NDArray[np.void]:
    vertices = np.zeros(chunk.stop - chunk.start, layout)
    points = turned(cloud.points_in_world[chunk], file_from_world)
    normals = turned(cloud.normals_in_world[chunk], file_from_world)
    for idx, name in enumerate("xyz"):
        vertices[name] = points[:, idx]
        vertices[f"n{name}"] = normals[:, idx]
    for idx, name in enumerate(("red", "green", "blue")):
        vertices[name] = cloud.colors_rgb[chunk, idx]
    names = layout.names or ()
    if "views" in names:
        vertices["views"] = cloud.view_counts[chunk]
        vertices["confidence"] = 0 if cloud.confidence is None else cloud.confidence[chunk]
    if "uncertainty" in names:
        vertices["uncertainty"] = np.nan if cloud.uncertainty is None else cloud.uncertainty[chunk]
    return vertices


def read_ply(path: Path) -> PointCloud:
    """Return the cloud in a PLY file that `write_ply` wrote, in the world frame; missing view counts are 0.

    Raises:
        InputError: if the file cannot be read, has another layout, or ends early.
    """
    head, mark, body = FilePart(path).read_bytes().partition(b"end_header\n")
    counted = re.search(rb"^element vertex ([0-9]{1,18})$", head, re.MULTILINE)
    count = int(counted[1]) if counted else 0
    plain = without_comments(head) + mark
    layout = next((known for known in _LAYOUTS if plain == _header(count, known)), None)
    if layout is None:
        raise InputError(f"{path}: not a PLY file of pano-mvs (binary little endian, x y z nx ny nz red green blue)")
    if len(body) != count * layout.itemsize:
        raise InputError(
            f"{path}: its header states {count} points, but it contains {len(body) // layout.itemsize}. Write it again"
        )
    vertices = np.frombuffer(body, layout)
    rotation = stated_rotation(head, path)
    world_from_file = None if rotation is None else rotation.T
    points, normals, colors = (
        np.stack([vertices[name] for name in names], axis=-1)
        for names in (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
    )
    names = layout.names or ()
    known = {name: vertices[name].copy() for name in ("views", "confidence", "uncertainty") if name in names}
    uncertainty = known.get("uncertainty")
    if uncertainty is not None and not np.isfinite(uncertainty).all():
        uncertainty = None
    views = known.get("views", np.zeros(count, np.uint8))
    return PointCloud(
        turned(points, world_from_file),
        turned(normals, world_from_file),
        colors,
        views,
        known.get("confidence"),
        uncertainty=uncertainty,
    )


def _header(count: int, layout: np.dtype[np.void], comments: str = "") -> bytes:
    properties = "".join(f"property {_PLY_TYPES[layout[name].kind]} {name}\n" for name in layout.names or ())
    return f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {count}\n{properties}end_header\n".encode()
