"""Layouts of faces: overlapping pinhole views that share the panorama's centre.

    for face in panorama_faces((512, 1024)):
        picture = face_image(panorama, face.view)

A layout is a list of directions. All faces of one panorama are squares with the same size and focal length, so that one
camera model is enough for a rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations, permutations, product
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.sampling import CUBE
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import PinholeView, spiral_rays
from pano_mvs.scene.files import FaceLayout


@cache
def face_centers() -> FloatArray:
    """Return the unit centres of the twenty faces, (20, 3); a direction belongs to the nearest one."""
    return np.array([triangle.mean(axis=0) / np.linalg.norm(triangle.mean(axis=0)) for triangle in _faces()])


@cache
def face_corners() -> FloatArray:
    """Return the unit corners of the twenty faces, (20, 3, 3): face, corner, axis."""
    return np.array(_faces())


def beyond_face_rad(bearings: FloatArray, face_idx: int) -> FloatArray:
    """Return by how many radians bearings (..., 3) are beyond the nearest edge of a face, (...,); negative inside."""
    centers = face_centers()
    across = centers - centers[face_idx]
    lengths = np.linalg.norm(across, axis=1)
    lengths[face_idx] = 1.0
    # The face's own centre gives 0, which would hide how far a bearing is inside the edges.
    beyond: FloatArray = np.delete(bearings @ (across / lengths[:, None]).T, face_idx, axis=-1).max(axis=-1)
    return beyond


def tangent_tiles(size_hw: tuple[int, int]) -> list[PinholeView]:
    """Return the twenty tiles for a panorama, at its own resolution at the equator (W / 2π px per radian)."""
    focal_px = size_hw[1] / (2 * np.pi)
    return [_tile(triangle, focal_px) for triangle in _faces()]


@cache
def _faces() -> tuple[FloatArray, ...]:
    """Return the corners (3, 3), unit vectors, of the twenty faces."""
    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([np.roll([0.0, a, b * golden], shift) for shift in range(3) for a in (-1, 1) for b in (-1, 1)])
    triples = [corners[list(triple)] for triple in combinations(range(12), 3)]
    faces = [t for t in triples if np.allclose([np.linalg.norm(t[i] - t[i - 1]) for i in range(3)], 2.0)]
    return tuple(face / np.linalg.norm(face[0]) for face in faces)


def _tile(triangle: FloatArray, focal_px: float) -> PinholeView:
    """Return the tile around a face, rotated so that one corner of the face is along the tile's y axis."""
    z = triangle.mean(axis=0) / np.linalg.norm(triangle.mean(axis=0))
    y = triangle[0] - (triangle[0] @ z) * z
    y /= np.linalg.norm(y)
    tile_from_cam = np.array([np.cross(y, z), y, z])
    in_tile = triangle @ tile_from_cam.T
    plane = in_tile[:, :2] / in_tile[:, 2:]
    # In units of the focal length; required by detectors and descriptors beyond the face.
    margin = max(0.17, 24 / focal_px)
    low, high = plane.min(axis=0) - margin, plane.max(axis=0) + margin
    width, height = np.ceil((high - low) * focal_px).astype(int)
    return PinholeView(tile_from_cam, focal_px, -low * focal_px, (int(height), int(width)))


# face_from_cam, rows: the face's x, y and z axis in the panorama's camera frame.
CUBE_ROTATIONS: FloatArray = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # front
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # right
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],  # back
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],  # left
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # up
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # down
    ],
    dtype=np.float64,
)
CUBE_NAMES = ("front", "right", "back", "left", "up", "down")
_OCTAGON_NAMES = ("front", "front-right", "right", "back-right", "back", "back-left", "left", "front-left")
_MIN_SIZE_PX = 4


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """One face of a layout.

    `name`: a plain word without `_`, unique in its layout; part of file names. `view`: the face as a pinhole view;
    `view.view_from_cam` is face_from_cam, `view.calibration` is K.
    """

    name: str
    view: PinholeView


@checks_settings
def panorama_faces(
    size_hw: tuple[int, int],
    *,
    layout: Annotated[FaceLayout, Setting("cube: 6 faces, octagon: 10, icosahedron: 20")] = "cube",
    fov_deg: Annotated[float, Setting("field of view of a face; faces overlap above 90", ge=30, le=150)] = 96.0,
    size_px: Annotated[
        int | None, Setting("width of a face; null: the resolution of the panorama", ge=_MIN_SIZE_PX, le=16384)
    ] = None,
) -> tuple[Face, ...]:
    """Return the faces of a panorama.

    The cube has six faces: front, right, back, left, up, down; "up" has the front below it, "down" above it. The
    octagon has eight around the horizon and the cube's up and down. The icosahedron has twenty, all upright. Below 90°
    (71° for the icosahedron), there are gaps between faces; see `covers_sphere`.

    Args:
        size_hw: (height, width) of the full sphere.

    Raises:
        UsageError: if the field of view or the size is out of bounds.
    """
    size = default_face_size(size_hw, fov_deg=fov_deg) if size_px is None else size_px
    focal_px = size / (2 * np.tan(np.radians(fov_deg) / 2))
    center = np.array([size / 2, size / 2])
    return tuple(
        Face(name, PinholeView(rotation, float(focal_px), center, (size, size)))
        for name, rotation in _rotations(layout)
    )


def default_face_size(size_hw: tuple[int, int], *, fov_deg: float) -> int:
    """Return the width at which the centre of a face has the resolution of the equator: (w / π) tan(fov / 2).

    Rounded up to an even number of pixels; the resolution increases towards the edges of a face.
    """
    exact = size_hw[1] / np.pi * np.tan(np.radians(fov_deg) / 2)
    return max(2 * int(np.ceil(exact / 2 - 1e-9)), _MIN_SIZE_PX)


def covers_sphere(faces: tuple[Face, ...]) -> bool:
    """Return whether every direction is in a face, tested for 20,000 evenly spread ones."""
    rays = spiral_rays(20_000)
    seen = np.zeros(len(rays), np.bool_)
    for face in faces:
        seen |= face.view.contains(face.view.pixels_from_rays(rays))
    return bool(seen.all())


def upright_rotation(axis_in_cam: FloatArray) -> FloatArray:
    """Return the face_from_cam (3, 3) of a face in a direction (3,) other than up and down, without roll."""
    z = axis_in_cam / np.linalg.norm(axis_in_cam)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def _rotations(layout: FaceLayout) -> list[tuple[str, FloatArray]]:
    if layout == "cube":
        return list(zip(CUBE_NAMES, CUBE_ROTATIONS, strict=True))
    if layout == "octagon":
        azimuths = 2 * np.pi * np.arange(8) / 8
        around = [upright_rotation(np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])) for azimuth in azimuths]
        return [*zip(_OCTAGON_NAMES, around, strict=True), *zip(CUBE_NAMES[4:], CUBE_ROTATIONS[4:], strict=True)]
    return [(f"tile{idx:02d}", upright_rotation(center)) for idx, center in enumerate(face_centers())]


def arranged_faces(faces: Mapping[str, NDArray[np.uint8]]) -> tuple[dict[str, NDArray[np.uint8]], bool]:
    """Return the faces of a cube in the order and turns in which the picture continues across its twelve edges.

    The faces stay as they are unless another arrangement, in which the front stays in place, has less than half of
    their mean difference across the edges. Of 79 cubes of twelve public tours, all are the best arrangement themselves.
    With one face turned or two exchanged, in 790 draws, 99 % have more than 3 times the difference of the best one.

    Args:
        faces: f, r, b, l, u and d, as in `CUBE`, (S, S, 3) each; others are returned as they are.

    Returns:
        The faces, and whether they were rearranged.
    """
    side = len(faces["f"])
    if any(face.shape != (side, side, 3) for face in faces.values()):
        return dict(faces), False
    ratio, order, turns = best_arrangement(faces)
    # Between those of right and wrong cubes, see `arranged_faces`.
    if ratio < 2.0:
        return dict(faces), False
    names = list(CUBE)
    found = {name: np.rot90(faces[names[order[slot]]], turns[slot]) for slot, name in enumerate(names)}
    return {name: np.ascontiguousarray(face) for name, face in found.items()}, True


def best_arrangement(
    faces: Mapping[str, NDArray[np.uint8]],
) -> tuple[float, tuple[int, ...], tuple[int, ...]]:
    """Return how much worse the faces fit than in their best arrangement, a ratio of 1 or more, and that arrangement.

    Returns:
        The ratio; for each face of `CUBE`, which of the given ones stands there; by how many quarter turns, as in
        `np.rot90`. The face in front stays.
    """
    borders = np.stack([_borders(faces[name]) for name in CUBE])  # face, side, sample, colour
    # Seen from inside, one face runs along an edge clockwise, and the other one counter-clockwise.
    apart = np.abs(borders[:, :, None, None] - borders[None, None, :, :, ::-1]).mean(axis=(-1, -2))
    orders = np.array([(0, *others) for others in permutations(range(1, 6))])
    turns = np.array([(0, *others) for others in product(range(4), repeat=5)])
    total = np.zeros((len(orders), len(turns)))
    for one, side, other, other_side in _edges():
        # A counter-clockwise turn brings the side that follows clockwise into a place.
        sides, other_sides = (side + turns[:, one]) % 4, (other_side + turns[:, other]) % 4
        total += apart[orders[:, one, None], sides[None], orders[:, other, None], other_sides[None]]
    best = np.unravel_index(np.argmin(total), total.shape)
    ratio = float((total[0, 0] + 1e-6) / (total[best] + 1e-6))
    return ratio, tuple(orders[best[0]].tolist()), tuple(turns[best[1]].tolist())


def _borders(face: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the borders clockwise from the top, (4, samples, 3): averages of equal parts."""
    turned = [np.rot90(face, turn)[0] for turn in range(4)]  # a counter-clockwise turn brings the right side up
    parts = np.linspace(0, len(face), min(64, len(face)) + 1).astype(int)[:-1]
    return (
        np.stack([np.add.reduceat(row.astype(np.float64), parts, axis=0) for row in turned])
        / (np.diff(np.append(parts, len(face)))[None, :, None])
    )


def _edges() -> list[tuple[int, int, int, int]]:
    """Return the twelve edges: face and side, and the face and side beyond."""
    sides = []
    for right, down, forward in CUBE.values():
        axes = [-np.array(down), np.array(right), np.array(down), -np.array(right)]
        sides.append([(tuple((np.array(forward) + axis).tolist())) for axis in axes])
    places = [(face, side) for face in range(6) for side in range(4)]
    return [
        (face, side, other, other_side)
        for number, (face, side) in enumerate(places)
        for other, other_side in places[number + 1 :]
        if other != face and sides[face][side] == sides[other][other_side]
    ]
