"""Ground plans of rendered houses: a corridor with rooms on both sides, doors, windows, stairs, and cameras."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pano_mvs.geometry import Rigid3
from tools.benchmarks.poses.tours.furniture import BY_ROOM, GREY, WHITE, WOODS, Color, Part
from tools.benchmarks.poses.tours.materials import (
    CARPET,
    LAMP,
    PANE,
    PANELS,
    PLAIN,
    PLANKS,
    PLASTER,
    POSTER,
    TILES,
    WOOD,
)
from tools.benchmarks.poses.tours.rendering import Boxes

WALL = 0.12
"""Thickness of a wall in metres."""

_SLAB = 0.25
_DOOR = (0.85, 2.05)
_STAIR = 1.0


@dataclass(frozen=True)
class Style:
    """What a house is like.

    Attributes:
        length: of the corridor in metres.
        storeys: one or two, joined by a stair.
        equal: whether all rooms are the same offices, with equal furniture and posters.
        empty: share of rooms without furniture.
        spacing: least distance of two cameras in metres.
        tripod: whether the tripod is seen.
    """

    length: float
    storeys: int = 1
    equal: bool = False
    empty: float = 0.0
    spacing: float = 2.0
    tripod: bool = True


@dataclass(frozen=True)
class Camera:
    """A true camera: cam_from_world with z up, the heading of its picture's centre, and where it stands."""

    pose: Rigid3
    yaw_deg: float
    room: str


@dataclass(frozen=True)
class Room:
    """A room: its rectangle (x0, y0, x1, y1), what it is, its floor's height above the ground, and its own height."""

    name: str
    kind: str
    rectangle: tuple[float, float, float, float]
    floor: float
    height: float


@dataclass(frozen=True)
class Opening:
    """A door, window, balcony or opening in a wall along x (axis 0) or y, from start to end, on a floor.

    `bottom`, `top`: above the floor. `leaf_end`: where the free end of a door's open leaf is, (x, y).
    """

    axis: int
    line: float
    start: float
    end: float
    kind: str
    floor: float
    bottom: float
    top: float
    leaf_end: tuple[float, float] | None = None


@dataclass
class _Builder:
    """Collects boxes, the ground that furniture covers, and the doors."""

    rng: np.random.Generator
    frames: list[list[float]] = field(default_factory=list)
    kinds: list[tuple[int, int]] = field(default_factory=list)
    colors: list[Color] = field(default_factory=list)
    # Rectangles (x0, y0, x1, y1, floor) where no camera and no furniture can stand.
    taken: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    doors: list[tuple[float, float, float]] = field(default_factory=list)
    openings: list[Opening] = field(default_factory=list)

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float], material: int, color: Color,
            *, seed: int | None = None, turn_deg: float = 0.0) -> None:  # fmt: skip
        middle, half = 0.5 * (np.add(low, high)), 0.5 * (np.subtract(high, low))
        turn = np.radians(turn_deg)
        self.frames.append([*middle, *half, float(np.cos(turn)), float(np.sin(turn))])
        self.kinds.append((material, int(self.rng.integers(1 << 20)) if seed is None else seed))
        self.colors.append(color)

    def is_free(self, rectangle: tuple[float, float, float, float], floor: float) -> bool:
        x0, y0, x1, y1 = rectangle
        return not any(floor == level and x0 < b and a < x1 and y0 < d and c < y1 for a, c, b, d, level in self.taken)


def build(style: Style, *, seed: int) -> tuple[Boxes, list[Camera]]:
    """Return the surfaces of a house and its cameras in the order of a visit."""
    builder, cameras, _ = _built(style, seed)
    return Boxes(np.array(builder.frames), np.array(builder.kinds, np.int64), np.array(builder.colors)), cameras


def rooms_of(style: Style, *, seed: int) -> tuple[list[Room], list[Opening]]:
    """Return the rooms of a house that have a camera, up to the middle of their walls, and all openings of walls."""
    builder, cameras, rooms = _built(style, seed)
    seen = {camera.room for camera in cameras}
    return [room for room in rooms if room.name in seen], builder.openings


def _built(style: Style, seed: int) -> tuple[_Builder, list[Camera], list[Room]]:
    rng = np.random.default_rng([seed, 0x70])
    builder = _Builder(rng)
    wide, south, north = rng.uniform(1.5, 2.0), rng.uniform(3.4, 4.8), rng.uniform(4.9, 5.4)
    height, rooms = float(rng.uniform(2.45, 2.7)), []
    for storey in range(style.storeys):
        floor = storey * (height + _SLAB)
        found = _storey(builder, style, floor=floor, sizes=(wide, south, north), height=height, storey=storey)
        rooms += found
    return builder, _cameras(builder, style, rooms), rooms


def _storey(
    builder: _Builder, style: Style, *, floor: float, sizes: tuple[float, float, float], height: float, storey: int
) -> list[Room]:
    """Build one storey and return its rooms, the corridor first."""
    rng, (wide, south, north), length = builder.rng, sizes, style.length
    stairs = style.storeys > 1
    rooms = [Room(f"corridor {storey}", "corridor", (0.0, 0.0, length, wide), floor, height)]
    kinds = ["living", "kitchen", "bath", "bedroom", "study", "bedroom", "bath", "store", "bedroom", "study"] * 3
    rng.shuffle(kinds)
    kinds.insert(0, "living" if storey == 0 else "bedroom")
    for side, (y0, y1) in enumerate(((-south, 0.0), (wide, wide + north))):
        edges = [0.0]
        if side and stairs:
            edges.append(3.4)
        while length - edges[-1] > 5.5:
            left = length - edges[-1]
            edges.append(edges[-1] + (3.2 if style.equal else float(rng.uniform(2.4, min(5.0, left - 2.4)))))
        edges.append(length)
        for left, right in pairwise(edges):
            hall = side == 1 and stairs and left == 0.0
            kind = "hall" if hall else "office" if style.equal else kinds.pop(0)
            if kind == "bath" and right - left > 3.6:
                kind = "bedroom"
            rooms.append(Room(f"{kind} {storey}.{len(rooms)}", kind, (left, y0, right, y1), floor, height))
    for room in rooms:
        _shell(builder, room, height, hole=storey > 0 and room.kind == "hall", last=storey + 1 == style.storeys)
    _walls(builder, rooms, height)
    twins: dict[str, int] = {}
    for room in rooms:
        if room.kind == "hall" and storey == 0:
            _stairs(builder, room, height + _SLAB)
        if rng.random() >= style.empty:
            own = twins.setdefault(room.kind, int(rng.integers(1 << 20))) if style.equal else int(rng.integers(1 << 20))
            _furnish(builder, room, np.random.default_rng(own))
    return rooms


def _shell(builder: _Builder, room: Room, height: float, *, hole: bool, last: bool) -> None:
    """Add floor, ceiling and lamps of a room; with a hole, the floor leaves out the stair."""
    rng, (x0, y0, x1, y1), z = builder.rng, room.rectangle, room.floor
    material = {"bath": TILES, "kitchen": TILES, "bedroom": CARPET, "office": CARPET}.get(room.kind, PLANKS)
    color: Color = (0.62, 0.6, 0.57) if material in (TILES, CARPET) else WOODS[int(rng.integers(len(WOODS)))]
    pieces = [(x0, y0, x1, y1)]
    if hole:
        pieces = [(x0, y0, x1 - _STAIR, y1), (x1 - _STAIR, y0, x1, y0 + 0.5), (x1 - _STAIR, y0 + 3.9, x1, y1)]
        builder.taken.append((x1 - _STAIR - 0.2, y0 + 0.3, x1, y0 + 4.1, z))
        rail = ((x1 - _STAIR - 0.04, y0 + 0.5, z + 0.9), (x1 - _STAIR, y0 + 3.9, z + 0.95))
        builder.box(*rail, WOOD, WOODS[1])
        for y in np.arange(y0 + 0.5, y0 + 3.9, 0.35):
            builder.box((x1 - _STAIR - 0.03, y, z), (x1 - _STAIR - 0.01, y + 0.02, z + 0.9), PLAIN, GREY)
    seed = int(rng.integers(1 << 20))
    for a, b, c, d in pieces:
        builder.box((a, b, z - 0.02), (c, d, z), material, color, seed=seed)
        if z:  # the ceiling of the storey below
            builder.box((a, b, z - _SLAB), (c, d, z - 0.02), PLASTER, WHITE)
    if last:
        builder.box((x0, y0, z + height), (x1, y1, z + height + 0.2), PLASTER, WHITE)
    under = x1 - _STAIR if room.kind == "hall" else x1
    count = max(1, round((under - x0) / 4.0))
    for x in x0 + (np.arange(count) + 0.5) * (under - x0) / count:
        y, size = 0.5 * (y0 + y1), 0.18
        top = z + height
        builder.box((x - size, y - size, top - 0.09), (x + size, y + size, top - 0.001), LAMP, (1.0, 0.95, 0.86))


def _walls(builder: _Builder, rooms: list[Room], height: float) -> None:
    """Add the walls of a storey, each with its doors and windows."""
    rng, corridor = builder.rng, rooms[0]
    length, wide, z = corridor.rectangle[2], corridor.rectangle[3], corridor.floor
    inner: dict[float, list[tuple[float, float, str]]] = {0.0: [], wide: []}
    outer: dict[float, list[tuple[float, float, str]]] = {}
    for room in rooms[1:]:
        x0, y0, x1, y1 = room.rectangle
        near, far = (y1, y0) if y0 < 0 else (y0, y1)
        if room.kind == "hall" or (room.kind == "living" and x1 - x0 > 3.0):
            inner[near].append((x0 + 0.4, x1 - (_STAIR + 0.2 if room.kind == "hall" else 0.4), "opening"))
        else:
            at = float(rng.uniform(x0 + 0.3, x1 - 0.3 - _DOOR[0]))
            inner[near].append((at, at + _DOOR[0], "door"))
        outer.setdefault(far, [])
        if room.kind not in ("store", "hall"):
            span = min(float(rng.uniform(0.9, 2.2)), x1 - x0 - 0.6)
            at = float(rng.uniform(x0 + 0.3, x1 - 0.3 - span))
            outer[far].append((at, at + span, "balcony" if room.kind == "living" else "window"))
        if x1 < length:
            between = [(y0 + 0.4, y0 + 0.4 + _DOOR[0], "door")] if rng.random() < 0.15 and room.kind != "hall" else []
            _wall(builder, (1, x1, y0, y1), (z, height), between)
    for line, openings in (*inner.items(), *outer.items()):
        _wall(builder, (0, line, 0.0, length), (z, height), openings)
    low, high = min(outer), max(outer)
    for x in (0.0, length):
        _wall(builder, (1, x, low, high), (z, height), [(0.3, wide - 0.3, "window")])


def _wall(
    builder: _Builder,
    place: tuple[int, float, float, float],
    level: tuple[float, float],
    openings: list[tuple[float, float, str]],
) -> None:
    """Add a wall along x (axis 0) or y at a line, from start to end, with openings (from, to, kind)."""
    axis, line, start, end = place
    z, height = level

    def add(a: float, b: float, low: float, high: float, material: int, color: Color, half: float = WALL / 2) -> None:
        across, along = (line - half, line + half), (a, b)
        x, y = (along, across) if axis == 0 else (across, along)
        if b - a > 1e-6:
            builder.box((x[0], y[0], z + low), (x[1], y[1], z + high), material, color)

    trim: Color = WHITE if builder.rng.random() < 0.5 else WOODS[int(builder.rng.integers(len(WOODS)))]
    at = start
    for a, b, kind in sorted(openings):
        bottom, top = {"window": (0.9, 2.1), "balcony": (0.05, 2.15), "opening": (0.0, 2.3)}.get(kind, (0.0, _DOOR[1]))
        builder.openings.append(Opening(axis, line, a, b, kind, z, bottom, top))
        add(at, a, 0.0, height, PLASTER, WHITE)
        add(a, b, top, height, PLASTER, WHITE)
        if bottom > 0:
            add(a, b, 0.0, bottom, PLASTER, WHITE)
            add(a, b, bottom, top, PANE, WHITE, half=0.01)
            for edge in np.linspace(a, b - 0.05, max(2, round((b - a) / 0.8) + 1)):
                add(float(edge), float(edge) + 0.05, bottom, top, PLAIN, trim, half=0.035)
            for low in (bottom, top - 0.05):
                add(a, b, low, low + 0.05, PLAIN, trim, half=0.037)
            if kind == "window":
                for fin in np.arange(a + 0.1, b - 0.1, 0.06):  # a radiator
                    add(float(fin), float(fin) + 0.045, 0.15, 0.7, PLAIN, WHITE, half=0.17)
        else:
            for left in (a, b - 0.05):
                add(left, left + 0.05, 0.0, top, WOOD, trim, half=WALL / 2 + 0.015)
            add(a, b, top - 0.05, top, WOOD, trim, half=WALL / 2 + 0.015)
            for low in (0.28, 1.08):  # a socket and a switch
                add(b + 0.12, b + 0.2, low, low + 0.08, PLAIN, (0.6, 0.6, 0.58), half=WALL / 2 + 0.008)
            middle = (0.5 * (a + b), line) if axis == 0 else (line, 0.5 * (a + b))
            builder.doors.append((*middle, z))
            clear = 0.9 if kind == "door" else 0.5
            across, along = (line - clear, line + clear), (a, b)
            x, y = (along, across) if axis == 0 else (across, along)
            builder.taken.append((x[0], y[0], x[1], y[1], z))
            if kind == "door" and axis == 0:
                builder.openings[-1] = replace(
                    builder.openings[-1], leaf_end=_door_leaf(builder, (a, b, line, z), trim)
                )
        at = b
    add(at, end, 0.0, height, PLASTER, WHITE)


def _door_leaf(builder: _Builder, place: tuple[float, float, float, float], color: Color) -> tuple[float, float]:
    """Add the open leaf of a door in a wall along x, on the side of the room, and return its free end."""
    a, b, line, z = place
    side = -1.0 if line <= 0 else 1.0
    turn = np.radians(float(builder.rng.uniform(65, 105))) * side
    half = 0.5 * (b - a) - 0.04
    x, y = a + 0.05 + half * np.cos(turn), line + side * 0.05 + half * np.sin(turn)
    high = z + _DOOR[1] - 0.06
    builder.box((x - half, y - 0.02, z + 0.01), (x + half, y + 0.02, high), PANELS, color,
                turn_deg=float(np.degrees(turn)))  # fmt: skip
    return x + half * float(np.cos(turn)), y + half * float(np.sin(turn))


def _stairs(builder: _Builder, hall: Room, rise: float) -> None:
    """Add a stair along the right wall of a hall."""
    _, y0, x1, _ = hall.rectangle
    steps = 16
    color = WOODS[int(builder.rng.integers(len(WOODS)))]
    for step in range(steps):
        y, top = y0 + 0.6 + 3.3 * step / steps, hall.floor + rise * (step + 1) / steps
        builder.box((x1 - _STAIR, y, top - 0.2), (x1 - WALL / 2, y + 3.3 / steps, top), WOOD, color)
    builder.taken.append((x1 - _STAIR - 0.2, y0, x1, y0 + 4.2, hall.floor))


def _furnish(builder: _Builder, room: Room, rng: np.random.Generator) -> None:
    """Put the furniture of a room along its walls, and posters above it, where there is space."""
    x0, y0, x1, y1 = room.rectangle
    for piece in BY_ROOM[room.kind]:
        parts = list(piece(rng))
        low, high = (edge(np.array([getattr(part, name) for part in parts])[:, :2], axis=0)
                     for edge, name in ((np.min, "low"), (np.max, "high")))  # fmt: skip
        for wall, share in zip(rng.permutation(4).repeat(4), rng.random(16), strict=True):
            turn = 90 * int(wall)
            # Walls in the order south, east, north, west, seen from inside.
            along = (x1 - x0) if wall % 2 == 0 else (y1 - y0)
            at = share * (along - (high[0] - low[0]) - 0.2) - low[0] + 0.1
            if along < high[0] - low[0] + 0.2:
                continue
            edge = 0.07
            place = ((x0 + at, y0 + edge), (x1 - edge, y0 + at), (x1 - at, y1 - edge), (x0 + edge, y1 - at))[int(wall)]
            corners = np.array([_turned(corner, turn) for corner in (low, high)]) + place
            rectangle = (*corners.min(axis=0), *corners.max(axis=0))
            inside = rectangle[0] > x0 and rectangle[1] > y0 and rectangle[2] < x1 and rectangle[3] < y1
            if inside and builder.is_free(rectangle, room.floor):
                _put(builder, parts, place=place, turn=turn, floor=room.floor, seed=int(rng.integers(1 << 20)))
                builder.taken.append((*rectangle, room.floor))
                break
    if room.kind != "corridor":
        _posters(builder, room, rng)


def _put(
    builder: _Builder, parts: list[Part], *, place: tuple[float, float], turn: int, floor: float, seed: int
) -> None:
    for number, part in enumerate(parts):
        middle = 0.5 * (np.array(part.low) + part.high)
        half = 0.5 * np.subtract(part.high, part.low)
        x, y = np.array(_turned(middle[:2], turn)) + place
        low, high = np.array([x, y, middle[2] + floor]) - half, np.array([x, y, middle[2] + floor]) + half
        builder.box(tuple(low), tuple(high), part.material, part.color, seed=seed + number,
                    turn_deg=part.turn_deg + turn)  # fmt: skip


def _turned(point: np.ndarray, turn: int) -> tuple[float, float]:
    x, y = float(point[0]), float(point[1])
    return ((x, y), (-y, x), (-x, -y), (y, -x))[turn // 90]


def _posters(builder: _Builder, room: Room, rng: np.random.Generator) -> None:
    """Hang a few pictures on the walls along y; there are only six different ones in all houses."""
    x0, y0, x1, y1 = room.rectangle
    for x, inwards in ((x0, 1.0), (x1, -1.0)):
        if rng.random() < 0.6:
            y, z = float(rng.uniform(y0 + 0.3, y1 - 1.0)), room.floor + float(rng.uniform(1.3, 1.6))
            wide, high = float(rng.uniform(0.4, 0.7)), float(rng.uniform(0.4, 0.6))
            near, far = sorted((x + inwards * 0.06, x + inwards * 0.075))
            color = (float(rng.random()), float(rng.random()), float(rng.random()))
            builder.box(
                (near, y, z - high / 2), (far, y + wide, z + high / 2), POSTER, color, seed=int(rng.integers(6))
            )


def _cameras(builder: _Builder, style: Style, rooms: list[Room]) -> list[Camera]:
    """Return cameras in free places of the rooms, at least the spacing of the style apart where there are several."""
    rng, height = builder.rng, float(builder.rng.uniform(1.45, 1.65))
    chosen: list[tuple[np.ndarray, str]] = []
    for room in rooms:
        x0, y0, x1, y1 = room.rectangle
        margin = 0.45
        places = rng.uniform((x0 + margin, y0 + margin), (x1 - margin, y1 - margin), (400, 2))
        free = [place for place in places if _can_stand(builder, room, place)]
        here: list[np.ndarray] = []
        for place in free:
            others = [*here, *(other[:2] for other, _ in chosen if other[2] == room.floor + height)]
            if all(np.linalg.norm(place - other) >= style.spacing for other in others):
                here.append(place)
        if not here and free:
            here = free[:1]
        chosen += [(np.array([*place, room.floor + height]), room.name) for place in here]
        if room.kind == "hall" and room.floor == 0.0:
            step = rooms[-1].floor * 0.5
            chosen.append((np.array([x1 - 0.5 * _STAIR, y0 + 2.2, step + height]), "stair"))
    cameras = []
    for center, name in chosen:
        yaw = float(rng.uniform(0, 360))
        tilt = np.radians(rng.normal(0, 0.5, 2))
        center = center + np.array([0.0, 0.0, rng.normal(0, 0.01)])
        cameras.append(Camera(Rigid3.from_center(level_rotation(yaw, tilt), center), yaw, name))
    return cameras


def _can_stand(builder: _Builder, room: Room, place: np.ndarray) -> bool:
    x, y = place
    return all(
        level != room.floor or not (a - 0.3 < x < c + 0.3 and b - 0.3 < y < d + 0.3)
        or min(np.hypot(x - p, y - q) for p, q, _ in builder.doors) < 0.35
        for a, b, c, d, level in builder.taken
    )  # fmt: skip


def level_rotation(yaw_deg: float, tilt: np.ndarray) -> np.ndarray:
    """Return cam_from_world of a camera whose picture's centre has a compass heading, almost upright."""
    yaw = np.radians(yaw_deg)
    ahead = np.array([np.sin(yaw), np.cos(yaw), 0.0])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    level = np.stack([right, [0.0, 0.0, -1.0], ahead])
    (a, b), one = tilt, 1.0
    roll = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, one]])
    pitch = np.array([[one, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return np.asarray(roll @ pitch @ level)
