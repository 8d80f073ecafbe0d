"""A city of blocks and a building of rooms, as large as a capture needs, with the path of a camera through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from tools.benchmarks.large.rendering import Boxes, draw

_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]


@dataclass(frozen=True)
class Place:
    """A place and the cameras of a capture.

    Attributes:
        boxes: of the place.
        poses: cam_from_world of each camera, along the path.
        reach: distance beyond which nothing is drawn.
    """

    boxes: Boxes
    poses: list[Rigid3]
    reach: float

    def write(self, folder: Path, *, width: int, views: int = 0) -> dict[str, Rigid3]:
        """Draw the first images that a folder does not have yet, and return the true poses of all, by name."""
        folder.mkdir(parents=True, exist_ok=True)
        truth = {f"{idx:05d}.jpg": pose for idx, pose in enumerate(self.poses)}
        for name, pose in list(truth.items())[: views or None]:
            if not (folder / name).is_file():
                image, _ = draw(self.boxes, pose, (width // 2, width), reach=self.reach)
                part = folder.with_suffix(".part.jpg")
                cv2.imwrite(str(part), image[:, :, ::-1], _QUALITY)
                part.rename(folder / name)
        return truth


class _Builder:
    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self._rows: list[tuple[tuple[float, ...], ...]] = []

    def box(self, low: tuple[float, ...], high: tuple[float, ...], windows: tuple[float, float] = (0.0, 0.0)) -> None:
        self._rows.append((low, high, tuple(self.rng.uniform(0.35, 0.95, 3).tolist()), windows))

    def boxes(self) -> Boxes:
        low, high, colors, windows = (np.array(part, dtype=np.float64) for part in zip(*self._rows, strict=True))
        return Boxes(low, high, colors, windows)


_STREET, _EYE = 14.0, 2.2  # width of a street, and height of the camera on a car, in metres


def city(views: int, *, seed: int = 0, step: float = 2.5, block: float = 56.0) -> Place:
    """Return streets between blocks of houses, with cars, signs and kerbs, driven line by line, to and fro.

    The first half of the path follows the streets in one direction, the second those across, so that it meets itself
    at every crossing.
    """
    pitch = block + _STREET
    lines = _lines(views * step / pitch)
    builder = _Builder(seed)
    extent = lines * pitch
    builder.box((-60, 0, -60), (extent + 60, 1, extent + 60))
    for row in range(-1, lines):
        for column in range(-1, lines):
            _block(builder, column * pitch + _STREET / 2, row * pitch + _STREET / 2, block)
    corners = [np.zeros(2)]
    for axis in (0, 1):
        for line in range(lines):
            ends = [0.0, (lines - 1) * pitch]
            for end in ends if line % 2 == 0 else ends[::-1]:
                corner = np.array([end, line * pitch]) if axis == 0 else np.array([line * pitch, end])
                corners.append(corner)
    return Place(builder.boxes(), _along(corners, views, step, height=-_EYE, builder=builder), 75.0)


def _block(builder: _Builder, x: float, z: float, size: float) -> None:
    """Add the pavement, the houses on the four sides of a block, and what stands before them."""
    rng = builder.rng
    builder.box((x - 2, -0.12, z - 2), (x + size + 2, 0, z + size + 2))
    depth = 12.0
    for side in range(4):
        along = depth if side % 2 else 0.0
        while along < size - (depth if side % 2 else 0) - 5:
            wide = min(rng.uniform(6, 14), size - (depth if side % 2 else 0) - along)
            height, back = -rng.uniform(5, 18), rng.uniform(0, 1.2)
            inner, outer = (back, depth) if side < 2 else (size - depth, size - back)
            low = (x + along, height, z + inner) if side % 2 == 0 else (x + inner, height, z + along)
            high = (x + along + wide, 0, z + outer) if side % 2 == 0 else (x + outer, 0, z + along + wide)
            builder.box(low, high, (rng.uniform(1.2, 3.2), rng.uniform(2.4, 3.6)))
            along += wide
    for side in range(4):
        for _ in range(int(size // 6)):
            along, out = rng.uniform(0, size), -rng.uniform(2.3, 3.8)
            long, wide, tall = (4.2, 1.7, 1.5) if rng.random() < 0.5 else rng.uniform((0.1, 0.1, 1.0), (1.2, 0.8, 4.0))
            near = out - wide if side < 2 else size - out
            sizes = (long, wide) if side % 2 == 0 else (wide, long)
            place = (x + along, z + near) if side % 2 == 0 else (x + near, z + along)
            builder.box((place[0], -tall, place[1]), (place[0] + sizes[0], -0.02, place[1] + sizes[1]))


_LONG, _WIDE, _CEILING, _CAMERA, _DOOR, _HALF_WALL = 7.0, 6.0, 3.2, 1.5, 1.4, 0.08


def building(views: int, *, seed: int = 0, step: float = 1.4) -> Place:
    """Return rooms on a grid, with doors to all neighbours and furniture, walked row by row, then by column."""
    builder = _Builder(seed)
    lines = _lines(views * step / _WIDE)
    wide, long = lines * _WIDE, lines * _LONG
    builder.box((0, -_CEILING, 0), (wide, 0, long))
    for row in range(lines):
        for column in range(lines):
            _room(builder, column * _WIDE, row * _LONG, (column > 0, row > 0))
    corners = []
    for axis in (0, 1):
        for line in range(lines):
            last = lines - 1
            for end in (0, last) if line % 2 == 0 else (last, 0):
                column, row = (end, line) if axis == 0 else (line, end)
                corners.append(np.array([(column + 0.5) * _WIDE, (row + 0.5) * _LONG]))
    return Place(builder.boxes(), _along(corners, views, step, height=-_CAMERA, builder=builder), 22.0)


def _room(builder: _Builder, x: float, z: float, walls: tuple[bool, bool]) -> None:
    """Add the walls towards the neighbours before a room, with their doors, and what is in it."""
    rng = builder.rng
    for axis, there in enumerate(walls):
        if not there:
            continue
        length = _LONG if axis == 0 else _WIDE
        middle = length / 2
        for start, end, bottom in (
            (0.0, middle - _DOOR / 2, 0.0),
            (middle + _DOOR / 2, length, 0.0),
            (middle - _DOOR / 2, middle + _DOOR / 2, -2.2),
        ):
            if axis == 0:
                builder.box((x - _HALF_WALL, -_CEILING, z + start), (x + _HALF_WALL, bottom, z + end))
            else:
                builder.box((x + start, -_CEILING, z - _HALF_WALL), (x + end, bottom, z + _HALF_WALL))
    for corner in range(4):
        for _ in range(2):
            sizes = rng.uniform((0.3, 0.4, 0.3), (1.0, 2.0, 1.0))
            left = x + 0.2 + rng.uniform(0, 1) if corner % 2 else x + _WIDE - 0.2 - sizes[0] - rng.uniform(0, 1)
            front = z + 0.2 + rng.uniform(0, 1.2) if corner < 2 else z + _LONG - 0.2 - sizes[2] - rng.uniform(0, 1.2)
            builder.box((left, -float(sizes[1]), front), (left + sizes[0], -0.01, front + sizes[2]))
    for _ in range(3):
        left, front = x + rng.uniform(0.6, _WIDE - 1.2), z + rng.uniform(0.6, _LONG - 1.2)
        builder.box((left, -_CEILING + 0.01, front), (left + 0.3, -_CEILING + rng.uniform(0.1, 0.5), front + 0.3))


def _lines(crossings: float) -> int:
    """Return the number of lines of a square grid whose path meets so many crossings."""
    lines = 2
    while 2 * lines * (lines - 1) < crossings:
        lines += 1
    return lines


def _along(
    corners: list[NDArray[np.float64]], views: int, step: float, *, height: float, builder: _Builder
) -> list[Rigid3]:
    """Return cameras every `step` along a path through corners (x, z), looking about where it leads, nearly level."""
    rng, path = builder.rng, np.array(corners)
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    path = np.concatenate([path[:1], path[1:][lengths > 0]])
    along = np.concatenate([[0.0], np.cumsum(lengths[lengths > 0])])
    if views > along[-1] / step + 1:
        raise ValueError(f"the path has {int(along[-1] / step) + 1} views, not {views}")
    poses = []
    for distance in np.arange(views) * step:
        here, ahead = (
            np.array([np.interp(at, along, path[:, k]) for k in (0, 1)]) for at in (distance, distance + 0.5)
        )
        yaw = float(np.arctan2(*(ahead - here))) + rng.normal(0, 0.1)
        center = (here[0] + rng.normal(0, 0.1), height + rng.normal(0, 0.03), here[1] + rng.normal(0, 0.1))
        tilt = rotation_from_rotvec(rng.normal(0, np.radians(2), 3))
        poses.append(Rigid3.from_center(tilt @ rotation_from_rotvec((0.0, -yaw, 0.0)), np.array(center)))
    return poses


PLACES: dict[str, Callable[[int], Place]] = {"city": city, "building": building}
