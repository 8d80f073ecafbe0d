"""A box with walls of known colours around panoramas, and a board in front of one of its walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.view_quality import PaintView, surface_view
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import RangeMap

HALF = np.array([2.0, 1.2, 1.6])
WALL_COLORS = np.array(
    [[200, 40, 40], [40, 200, 40], [40, 40, 200], [200, 200, 40], [40, 200, 200], [200, 40, 200]], np.uint8
)
"""Of the walls −x, +x, −y, +y, −z, +z."""
BOARD, BOARD_COLOR = 6, (250, 250, 250)

Surface = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int64]]
"""Vertices, triangles, and the number of the wall of each triangle."""


def box(steps: int = 4, *, board: bool = False) -> Surface:
    """Return the inner walls of the box, each of steps × steps quads; with a board 0.8 in front of the wall +z."""
    parts = [_quads(axis, sign, HALF, steps) for axis in range(3) for sign in (-1.0, 1.0)]
    if board:
        parts.append(_quads(2, 1.0, np.array([0.5, 0.4, 0.8]), steps))
    vertices = np.concatenate([points for points, _ in parts]).astype(np.float32)
    first = np.cumsum([0, *(len(points) for points, _ in parts)])
    faces = np.concatenate([triangles + start for (_, triangles), start in zip(parts, first, strict=False)])
    wall = np.repeat(np.arange(len(parts)), [len(triangles) for _, triangles in parts])
    return vertices, faces.astype(np.int32), wall


def _quads(
    axis: int, sign: float, half: NDArray[np.float64], steps: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    others = [other for other in range(3) if other != axis]
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, steps + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.zeros((len(grid), 3))
    points[:, axis], points[:, others] = sign * half[axis], grid * half[others]
    corner = np.arange(len(grid)).reshape(steps + 1, steps + 1)
    around = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([around[:, [0, 1, 2]], around[:, [0, 2, 3]]])
    first = points[triangles[0]]
    inwards = np.cross(first[1] - first[0], first[2] - first[0])[axis] * sign < 0
    return points, triangles if inwards else triangles[:, ::-1]


def poses(count: int = 3) -> list[Rigid3]:
    """Return cameras in the box, tilted and turned."""
    rng = np.random.default_rng(4)
    centers = rng.uniform(-0.6, 0.6, (count, 3)) * (1, 0.6, 0.8)
    return [Rigid3.from_center(rotation_from_rotvec(rng.normal(0, 0.5, 3)), center) for center in centers]


@dataclass(frozen=True, eq=False)
class Capture:
    """Panoramas of the box.

    Attributes:
        surface: the true surface.
        views: what each camera sees, with true ranges.
    """

    surface: Surface
    views: list[PaintView]

    def load(self, idx: int) -> PaintView:
        return self.views[idx]


def capture(
    cameras: Sequence[Rigid3], *, board: bool = False, size_hw: tuple[int, int] = (64, 128), steps: int = 4
) -> Capture:
    """Render panoramas of the box in its plain colours."""
    surface = box(steps, board=board)
    colors = np.concatenate([WALL_COLORS, [BOARD_COLOR]]).astype(np.uint8)
    views = []
    for pose in cameras:
        seen = surface_view(surface[0], surface[1], pose, size_hw=size_hw)
        ranges = RangeMap(seen.ranges, np.full(size_hw, 200, np.uint8))
        picture = colors[surface[2][seen.triangle]]
        views.append(PaintView(pose, picture, np.ones(size_hw, np.bool_), ranges))
    return Capture(surface, views)
