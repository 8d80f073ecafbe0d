"""What stands a little before plain walls and ceilings: beams, cables, lamps, shelves, frames, in rendered rooms.

Rooms are drawn by a number: their size, what they have, and cameras around the middle, almost level and turned
arbitrarily. The dense stages of a workflow are run with the true poses. After each of the last two, in `quality` before
`depth.structure` and after it:

* protruding: of the solid angle where something stands .5 to 20 % before the floor, the ceiling or a wall, the share
  within 1 % of the truth;
* pressed flat: the share of it that is within .5 % of the floor, ceiling or wall instead;
* walls, level: share of their solid angle within 1 %;
* all: share of what has a range within 5 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid
from pano_mvs.scene import FilePart, Panorama, RangeMap
from tools.benchmarks.captures import SCRATCH, Capture
from tools.benchmarks.dense_chain import DenseChain, Overrides
from tools.benchmarks.depth.houses import total
from tools.benchmarks.poses.tours.furniture import DARK, GREY, WHITE, WOODS, Color
from tools.benchmarks.poses.tours.materials import (
    BOOKS,
    CARPET,
    LAMP,
    PANE,
    PLAIN,
    PLANKS,
    PLASTER,
    POSTER,
    TILES,
    WOOD,
)
from tools.benchmarks.poses.tours.plan import level_rotation
from tools.benchmarks.poses.tours.rendering import Boxes, first_surfaces, lit, panorama
from tools.benchmarks.table import print_table

# Capture worlds have y down, rooms z up.
_Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_PALE: tuple[Color, ...] = (WHITE, (0.8, 0.76, 0.66), (0.7, 0.75, 0.78), (0.78, 0.7, 0.62))

Corner = tuple[float, float, float]


class _Room:
    """Collects the boxes of a room from (0, 0, 0) to its size."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.size: Corner = (rng.uniform(3.5, 9.0), rng.uniform(3.2, 7.0), rng.uniform(2.4, 3.4))
        self.frames: list[list[float]] = []
        self.kinds: list[tuple[int, int]] = []
        self.colors: list[Color] = []

    def box(self, low: Corner, high: Corner, material: int, color: Color, turn_deg: float = 0.0) -> None:
        middle, half, turn = np.add(low, high) / 2, np.subtract(high, low) / 2, np.radians(turn_deg)
        self.frames.append([*middle, *half, float(np.cos(turn)), float(np.sin(turn))])
        self.kinds.append((material, int(self.rng.integers(1 << 20))))
        self.colors.append(color)

    def on_wall(
        self, wall: int, along: tuple[float, float], up: tuple[float, float], deep: float, material: int, color: Color,
        *, gap: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a box before a wall (0, 1: low and high x; 2, 3: of y), from `gap` to `deep` before it."""
        axis, high = divmod(wall, 2)
        near, far = (self.size[axis] - deep, self.size[axis] - gap) if high else (gap, deep)
        low_xy, high_xy = ((near, along[0]), (far, along[1])) if axis == 0 else ((along[0], near), (along[1], far))
        self.box((*low_xy, up[0]), (*high_xy, up[1]), material, color)

    def place_on(self, wall: int, wide: float) -> tuple[float, float]:
        start = self.rng.uniform(0.1, max(self.length(wall) - wide - 0.1, 0.11))
        return float(start), float(start + wide)

    def length(self, wall: int) -> float:
        return self.size[1 - wall // 2]

    def any_wood(self) -> Color:
        return WOODS[int(self.rng.integers(len(WOODS)))]


def _shell(room: _Room) -> None:
    (x, y, z), rng = room.size, room.rng
    floor = int(rng.choice([TILES, CARPET, PLANKS, PLASTER]))
    room.box((0, 0, -0.1), (x, y, 0), floor, GREY if floor != PLANKS else room.any_wood())
    room.box((0, 0, z), (x, y, z + 0.1), int(rng.choice([PLASTER, PLASTER, TILES])), WHITE)
    wall = _PALE[int(rng.integers(len(_PALE)))]
    for number in range(4):
        pane = number == 0 or rng.random() < 0.3
        start, end = room.place_on(number, min(float(rng.uniform(1.0, 3.0)), room.length(number) - 0.4))
        length, bottom, top = room.length(number), 0.95, z - 0.35
        pieces = [(0.0, length, 0.0, z)]
        if pane:
            pieces = [(0.0, start, 0.0, z), (end, length, 0.0, z), (start, end, 0.0, bottom), (start, end, top, z)]
            room.on_wall(number, (start, end), (bottom, top), -0.06, PANE, WHITE, gap=-0.1)
            for edge in np.linspace(start, end - 0.06, max(2, round((end - start) / 0.8) + 1)):
                room.on_wall(number, (float(edge), float(edge) + 0.06), (bottom, top), -0.02, PLAIN, WHITE, gap=-0.1)
            for low in (bottom, top - 0.06):
                room.on_wall(number, (start, end), (low, low + 0.06), -0.02, PLAIN, WHITE, gap=-0.1)
            for fin in np.arange(start + 0.1, end - 0.1, 0.07):  # a radiator
                room.on_wall(number, (float(fin), float(fin) + 0.05), (0.15, 0.75), 0.12, PLAIN, WHITE, gap=0.04)
        for a, b, low, high in pieces:
            room.on_wall(number, (a, b), (low, high), 0.0, PLASTER, wall, gap=-0.15)
        if rng.random() < 0.8:
            room.on_wall(number, (0, length), (0, rng.uniform(0.06, 0.12)), 0.015, WOOD, room.any_wood())
        if rng.random() < 0.3:
            room.on_wall(number, (0, length), (z - 0.08, z), 0.06, PLASTER, WHITE)


def _ceiling(room: _Room) -> None:
    (x, y, z), rng = room.size, room.rng
    kind = rng.random()
    if kind < 0.6:
        spacing, wide, high = rng.uniform(0.8, 1.8), rng.uniform(0.1, 0.3), rng.uniform(0.06, 0.3)
        material, color = (WOOD, room.any_wood()) if rng.random() < 0.4 else (PLASTER, WHITE)
        for at in np.arange(rng.uniform(0.2, spacing), x - wide, spacing):
            room.box((at, 0, z - high), (at + wide, y, z), material, color)
    for _ in range(int(rng.integers(1, 4))):  # tubes that hang or are fixed
        at, low = rng.uniform(0.3, max(y - 1.7, 0.31)), z - rng.uniform(0.06, 0.6)
        side = rng.uniform(0.4, x - 0.6)
        room.box((side, at, low - 0.06), (side + 0.14, at + 1.3, low), LAMP, (1.0, 0.97, 0.9))
        for end in (at + 0.1, at + 1.2):
            room.box((side + 0.06, end, low), (side + 0.07, end + 0.01, z), PLAIN, DARK)
    for _ in range(int(rng.integers(0, 3))):  # cables and pipes
        at, thick = rng.uniform(0.2, y - 0.3), rng.uniform(0.015, 0.06)
        room.box((0, at, z - thick), (x, at + thick, z), PLAIN, GREY if rng.random() < 0.5 else WHITE)


def _on_walls(room: _Room) -> None:
    rng, z = room.rng, room.size[2]
    for wall in range(4):
        for _ in range(int(rng.integers(1, 5))):
            _hung(room, wall, int(rng.integers(7)))
        at = room.place_on(wall, 0.08)
        room.on_wall(wall, at, (1.05, 1.13), 0.012, PLAIN, (0.6, 0.6, 0.58))  # a switch
        if rng.random() < 0.5:
            room.on_wall(wall, room.place_on(wall, 0.03), (0, z), 0.02, PLAIN, WHITE)  # a duct


def _hung(room: _Room, wall: int, kind: int) -> None:
    rng, z = room.rng, room.size[2]
    wide = min(float(rng.uniform(0.4, 2.6) if kind in (0, 2) else rng.uniform(0.3, 1.2)), room.length(wall) - 0.3)
    at, low = room.place_on(wall, wide), float(rng.uniform(0.9, 1.5))
    if kind == 0:  # a board
        room.on_wall(wall, at, (low, low + 1.1), 0.05, PLAIN, (0.12, 0.22, 0.17) if rng.random() < 0.5 else WHITE)
    elif kind == 1:  # a picture in a frame
        high, color, edge = low + float(rng.uniform(0.3, 0.8)), room.any_wood(), 0.04
        room.on_wall(wall, at, (low, high), 0.015, POSTER, WHITE)
        for up in ((low, low + edge), (high - edge, high)):
            room.on_wall(wall, at, up, 0.035, WOOD, color)
        for across in ((at[0], at[0] + edge), (at[1] - edge, at[1])):
            room.on_wall(wall, across, (low, high), 0.035, WOOD, color)
    elif kind == 2:  # shelves with books on some
        deep, color = float(rng.uniform(0.2, 0.35)), room.any_wood()
        for level in low + 0.35 * np.arange(int(rng.integers(1, 3))):
            room.on_wall(wall, at, (level, level + 0.025), deep, WOOD, color)
            if rng.random() < 0.6:
                end = at[0] + wide * float(rng.uniform(0.3, 1))
                room.on_wall(wall, (at[0], end), (level + 0.025, level + 0.24), 0.8 * deep, BOOKS, color)
    elif kind == 3:  # a clock
        room.on_wall(wall, (at[0], at[0] + 0.3), (z - 0.6, z - 0.3), 0.04, PLAIN, DARK)
        room.on_wall(wall, (at[0] + 0.02, at[0] + 0.28), (z - 0.58, z - 0.32), 0.045, POSTER, WHITE)
    elif kind == 4:  # a column
        room.on_wall(wall, (at[0], at[0] + 0.3), (0, z), float(rng.uniform(0.05, 0.3)), PLASTER, WHITE)
    elif kind == 5:  # a closed door with its frame
        start = min(at[0], room.length(wall) - 1.1)
        room.on_wall(wall, (start, start + 0.95), (0, 2.08), 0.02, WOOD, room.any_wood())
        room.on_wall(wall, (start + 0.05, start + 0.9), (0, 2.03), 0.035, PLAIN, room.any_wood())
        room.on_wall(wall, (start + 0.1, start + 0.22), (1.02, 1.05), 0.09, PLAIN, GREY)
    else:  # a cupboard
        room.on_wall(wall, at, (0, float(rng.uniform(0.7, 2.1))), float(rng.uniform(0.3, 0.6)), WOOD, room.any_wood())


def _furniture(room: _Room) -> None:
    (x, y, _), rng = room.size, room.rng
    for _ in range(int(rng.integers(2, 8))):
        wide, deep, high = rng.uniform((0.6, 0.5, 0.5), (1.6, 0.8, 0.8))
        a, b = rng.uniform((0.5, 0.5), (max(x - wide - 0.5, 0.6), max(y - deep - 0.5, 0.6)))
        if abs(a + wide / 2 - x / 2) < wide / 2 + 1.0 and abs(b + deep / 2 - y / 2) < deep / 2 + 1.0:
            continue  # cameras stand there
        color = room.any_wood()
        room.box((a, b, high - 0.03), (a + wide, b + deep, high), WOOD, color)
        for dx in (0.0, wide - 0.04):
            for dy in (0.0, deep - 0.04):
                room.box((a + dx, b + dy, 0), (a + dx + 0.04, b + dy + 0.04, high - 0.03), PLAIN, GREY)
        if rng.random() < 0.6:
            room.box((a + 0.1, b + 0.1, high), (a + 0.4, b + 0.3, high + 0.2), POSTER, WHITE, float(rng.uniform(0, 90)))


@dataclass(frozen=True)
class DrawnRoom:
    """A capture of a room that extends from the origin to a corner (x, y, z up), for each view what it shows there.

    `hulls`: by image, (H, W) range to floor, ceiling or wall. `faces`: by image, (H, W) which of them, 4 and 5 are
    level.
    """

    capture: Capture
    hulls: dict[str, FloatArray]
    faces: dict[str, NDArray[np.intp]]


def protruding_room(seed: int, folder: Path, *, width: int, views: int) -> DrawnRoom:
    """Return a room; pictures that the folder does not have are rendered."""
    rng = np.random.default_rng([seed, 0xBEA])
    room = _Room(rng)
    for part in (_shell, _ceiling, _on_walls, _furniture):
        part(room)
    x, y, z = room.size
    boxes = Boxes(np.array(room.frames), np.array(room.kinds, np.int64), np.array(room.colors))
    middle, height = np.array([x / 2, y / 2]), min(float(rng.uniform(1.2, 1.7)), z - 0.9)
    cameras = []
    for _ in range(views):
        center = np.array([*(middle + rng.uniform(-0.75, 0.75, 2)), height + rng.uniform(-0.25, 0.25)])
        cameras.append(Rigid3.from_center(level_rotation(rng.uniform(0, 360), rng.normal(0, 0.01, 2)), center))
    folder.mkdir(parents=True, exist_ok=True)
    size, house = (width // 2, width), lit(boxes, seed=seed)
    panoramas, poses, ranges, hulls, faces = {}, {}, {}, {}, {}
    for idx, camera in enumerate(cameras):
        name = f"{idx:03d}.png"
        if not (folder / name).is_file():
            picture = panorama(house, camera, size_hw=size, rng=np.random.default_rng([seed, idx]), tripod=False)
            cv2.imwrite(str(folder / name), picture[..., ::-1])
        panoramas[name] = Panorama(FilePart(folder / name), size, size)
        poses[name] = Rigid3.from_center(camera.rotation @ _Y_DOWN.T, _Y_DOWN @ camera.center)
        true, box, _ = first_surfaces(house, camera, size)
        open_air = (box < 0) | (boxes.kinds[box, 0] == PANE)
        ranges[name] = np.where(open_air, np.nan, true).astype(np.float32)
        rays = ray_grid(size) @ camera.rotation
        with np.errstate(divide="ignore"):
            to_low, to_high = -camera.center / rays, (np.array(room.size) - camera.center) / rays
        reach = np.maximum(to_low, to_high)
        hulls[name] = reach.min(axis=-1)
        faces[name] = 2 * reach.argmin(axis=-1) + (
            np.take_along_axis(rays, reach.argmin(axis=-1)[..., None], -1)[..., 0] > 0
        )
    return DrawnRoom(Capture(f"room {seed}", panoramas, poses, ranges), hulls, faces)


def shares(room: DrawnRoom, name: str, range_map: RangeMap) -> dict[str, tuple[float, float]]:
    """Return the solid angle of each figure in one view, and of what it is a share of."""
    truth, hull, face = room.capture.ranges[name], room.hulls[name], room.faces[name]
    area = np.broadcast_to(pixel_solid_angle(hull.shape)[:, None], hull.shape)
    with np.errstate(invalid="ignore"):
        before = (truth < 0.995 * hull) & (truth > 0.8 * hull)
        on_it = np.abs(truth / hull - 1) < 1e-3
        error = np.nan_to_num(np.abs(range_map.range / truth - 1), nan=np.inf)
        flat = np.abs(range_map.range / hull - 1) < 0.005
    seen = np.isfinite(truth) & range_map.valid
    parts = {
        "protruding": (before & (error < 0.01), before),
        "pressed flat": (before & flat & (error >= 0.01), before),
        "walls": (on_it & (face < 4) & (error < 0.01), on_it & (face < 4)),
        "level": (on_it & (face >= 4) & (error < 0.01), on_it & (face >= 4)),
        "all": (seen & (error < 0.05), seen),
    }
    return {key: (float(area[which].sum()), float(area[of].sum())) for key, (which, of) in parts.items()}


def main(
    rooms: Annotated[list[int] | None, typer.Argument(help="numbers of rooms")] = None,
    *,
    workflow: str = "quality",
    overrides: Overrides = None,
    width: int = 1024,
    views: int = 5,
) -> None:
    """Measure rooms; by default those from 1 to 10.

    Args:
        rooms: their numbers.
        workflow: a preset or a file.
        overrides: settings of stages.
        width: of the panoramas, in pixels.
        views: number of views of each.
    """
    cv2.setNumThreads(1)
    chain = DenseChain(workflow, overrides=overrides or ())
    rows = []
    for number in rooms or range(1, 11):
        room = protruding_room(number, SCRATCH / f"room-{number}-{width}", width=width, views=views)
        for stage, maps in list(chain.run(room.capture).range_maps.items())[-2:]:
            figures = total([shares(room, name, maps[name]) for name in maps])
            rows.append((room.capture.name, stage, *(f"{value:.1f}" for value in figures.values())))
    print_table(["room", "after", *figures], rows)
