"""Find the outline of the room around each view by the lines where its walls meet floor and ceiling.

The heights of floor and ceiling are known, so that the distance of a wall predicts both of its creases, and one picture
is enough. Among upright planes, each azimuth gets the one whose creases the picture shows best, with few changes from
azimuth to azimuth (dynamic programming, after A. Flint, D. Murray, I. Reid, "Manhattan scene understanding using
monocular, stereo, and 3D features", ICCV 2011, section 3). Colours across a crease are compared as vectors, in the mean
of some degrees along it, so that texture cancels out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.structure.view import (
    STEP_RAD,
    PlaneView,
    ScenePlane,
    blurred,
    differences,
    plane_ranges,
    world_rays,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

Labels = NDArray[np.int64]

_AZIMUTHS = 360  # of an outline, from the z axis of the world towards its x axis
_LEAST_COSINE = 0.1
_HALF_WINDOW = 4  # azimuths along a crease
# The cost of a change of plane and of each relative step in distance there, in azimuths of clear creases.
_CHANGE, _STEP_SIZE, _MOST_STEPS = 2.0, 0.1, 3.0
# The planes of a search: distances in heights of the camera above the floor, and turns of four directions.
_DISTANCES = np.geomspace(0.35, 9.0, 110)
_TURNS_RAD, _FINE_TURNS_RAD = np.radians(np.arange(0.0, 90.0, 3.0)), np.radians(np.arange(-2.0, 2.1, 1.0))
# The turn is searched at every fourth azimuth of some views, with planes that are clear over 36°.
_TURN_VIEWS, _TURN_STEP, _TURN_SPAN = 6, 4, 9
# Heights of a ceiling above the cameras that are tried, in heights of the camera above the floor.
_CEILINGS = np.geomspace(0.3, 1.6, 36)
_SAME_RAD, _SAME_DISTANCE = np.radians(4.0), 0.05
OUTLINE_UNCERTAINTY = 0.03
"""Relative standard deviation of ranges on a wall that creases of single views alone show."""


class Room(NamedTuple):
    """The room around a view.

    `floor`, `ceiling`: positions of level planes. `walls`: (360,) position of the plane at each azimuth, −1 for none.
    """

    floor: int
    ceiling: int
    walls: Labels


@dataclass(frozen=True, eq=False)
class Skyline:
    """How colours change with the elevation around a view: (E, A, 3), in steps of 0.1° from the nadir up."""

    differences: NDArray[np.float32]
    half_window: int = _HALF_WINDOW

    @property
    def azimuths_rad(self) -> FloatArray:
        """The azimuths, (A,), from the z axis of the world towards its x axis."""
        return np.linspace(0, 2 * np.pi, self.differences.shape[1], endpoint=False)

    def clarity(self, distance: FloatArray, *, down: float, up: float) -> FloatArray:
        """Return how clear the creases of walls at level distances (L, A) are, from 0 to 2; −∞ for a NaN.

        `down`, `up`: heights of the camera above the floor, and of the ceiling above the camera.
        """
        seen = np.isfinite(distance)
        known = np.where(seen, distance, 1.0)
        total = np.zeros(distance.shape)
        for elevation in (-np.arctan2(down, known), np.arctan2(up, known)):
            common = _along(self._at(elevation) * seen[..., None], self.half_window)
            # A difference of colour that could not be clearer.
            total += np.sqrt(np.minimum(np.linalg.norm(common, axis=-1) / 20.0, 1.0))
        return np.where(seen, total, -np.inf)

    def _at(self, elevation: FloatArray) -> NDArray[np.float32]:
        place = (elevation + np.pi / 2) / STEP_RAD
        first = np.clip(place.astype(np.int64), 0, len(self.differences) - 2)
        part = (place - first)[..., None].astype(np.float32)
        column = np.arange(self.differences.shape[1])
        return np.asarray(self.differences[first, column] * (1 - part) + self.differences[first + 1, column] * part)


def skyline(picture: NDArray[np.float32], cam_from_world: Rigid3) -> Skyline:
    """Return how colours of a panorama from `blurred` change with the elevation, in a world with y down."""
    dip = np.pi / 2 - STEP_RAD * np.arange(round(np.pi / STEP_RAD) + 1)[:, None]
    rays = world_rays(np.linspace(0, 2 * np.pi, _AZIMUTHS, endpoint=False), dip) @ cam_from_world.rotation.T
    changes = differences(picture, rays, axis=0)
    return Skyline(np.pad(changes, [((len(dip) - len(changes)) // 2,) * 2, (0, 0), (0, 0)]))


def best_walls(clarity: FloatArray, distance: FloatArray) -> Labels:
    """Return the plane of each azimuth, (A,), so that creases are clear and planes change rarely; −1 without any.

    `clarity`: (L, A) of the planes at each azimuth, −∞ where one is not seen. `distance`: (L, A).
    """
    azimuths = clarity.shape[1]
    # One more plane, far away and without creases, stands for none.
    clarity = np.concatenate([clarity, np.zeros((1, azimuths))])
    place = np.log(np.concatenate([distance, np.full((1, azimuths), 1e9)])) / _STEP_SIZE
    seen = [np.flatnonzero(np.isfinite(column)) for column in clarity.T]
    total, came_from = np.zeros(len(seen[-1])), []
    for step in range(2 * azimuths):  # twice around, so that the end meets the start
        azimuth = step % azimuths
        before, now = seen[azimuth - 1], seen[azimuth]
        steps = np.abs(place[before, azimuth - 1][:, None] - place[now, azimuth])
        cost = np.where(before[:, None] == now, 0.0, _CHANGE + np.minimum(steps, _MOST_STEPS))
        reached = total[:, None] - cost
        came_from.append(reached.argmax(axis=0))
        total = reached.max(axis=0) + clarity[now, azimuth]
    found, at = np.zeros(2 * azimuths, np.int64), int(total.argmax())
    for step in range(2 * azimuths - 1, -1, -1):
        found[step] = seen[step % azimuths][at]
        at = int(came_from[step][at])
    middle = azimuths // 2
    walls = np.roll(found[middle : middle + azimuths], middle)
    return np.where(walls == len(distance), -1, walls)


def room_of(view: PlaneView, planes: Sequence[ScenePlane]) -> Room | None:
    """Return the room around a view, by creases and confirmed ranges; None without floor, ceiling or upright planes."""
    upright = [idx for idx, plane in enumerate(planes) if not plane.is_level]
    one = _around(view, planes)
    if not upright or not one.rooms:
        return None
    (floor, ceiling), distance, clarity = _clearest([(room, *_known_walls(one, planes, room)) for room in one.rooms])
    walls = best_walls(clarity, distance)
    return Room(floor, ceiling, np.where(walls < 0, -1, np.array(upright)[walls]))


def room_labels(room: Room, rays: FloatArray, ranges: Sequence[FloatArray]) -> Labels:
    """Return the plane that a view would show at each ray (..., 3) of the world in an empty room; −1 for none.

    `ranges`: of the rays to each plane, NaN where it is not seen.
    """
    wall = room.walls[azimuths_of(rays)]
    label, nearest = np.full(wall.shape, -1), np.full(wall.shape, np.inf)
    for idx, of_plane in enumerate(ranges):
        shown = (wall == idx) | (idx in (room.floor, room.ceiling))
        with np.errstate(invalid="ignore"):
            closer = shown & (of_plane < nearest)
        label[closer], nearest[closer] = idx, of_plane[closer]
    return np.where(wall >= 0, label, -1)


def supposed_ceiling(views: Sequence[PlaneView], planes: Sequence[ScenePlane]) -> list[ScenePlane]:
    """Return a ceiling at the height at which creases of all views are clearest; none if one is known, or no floor is.

    A room and a lower, narrower one look much the same in one view, but not in several. `views`: those with sky above
    are ignored. `planes`: the level planes of the views.
    """
    lowest = max((view.cam_from_world.center[1] for view in views), default=0.0)
    floors = [plane for plane in planes if plane.normal[1] < 0 and plane.y > lowest]
    roofed = [view for view in views if _is_roofed(view)]
    if not floors or not roofed or any(_rooms(planes, view.cam_from_world.center) for view in views):
        return []
    floor = max(floors, key=lambda plane: plane.support)
    middle = float(np.mean([view.cam_from_world.center[1] for view in roofed]))
    tried = [
        [floor, ScenePlane(-floor.normal, y, 0.0, 0.0, uncertainty=OUTLINE_UNCERTAINTY, is_level=True)]
        for y in middle - (floor.y - middle) * _CEILINGS
    ]
    drawn = _coarsely(roofed, tried[len(tried) // 2])
    turn = _turn(drawn, tried[len(tried) // 2])
    return [max(tried, key=lambda planes: _total(drawn, planes, turn))[1]]


def _is_roofed(view: PlaneView) -> bool:
    """Return whether most of the sphere around the zenith has a range."""
    above = view.rays[..., 1] < -0.7  # cosine of the angle to the zenith
    return bool(view.area[above & np.isfinite(view.ranges)].sum() > view.area[above].sum() / 2)


def outline_planes(views: Sequence[PlaneView], planes: Sequence[ScenePlane]) -> list[ScenePlane]:
    """Return upright planes that outlines show and that are not among `planes`, which have the level ones."""
    indoors = [view for view in views if _rooms(planes, view.cam_from_world.center)]
    if not indoors:
        return []
    turn = _turn(_coarsely(indoors, planes), planes)
    walls = [wall for view in indoors for wall in _walls_of(_around(view, planes), planes, turn)]
    found: list[ScenePlane] = []
    for _, wall, center in sorted(walls, key=lambda wall: -wall[0]):
        if not any(same_wall(wall, other, center[None]) for other in (*planes, *found)):
            found.append(wall)
    return found


_Tried = tuple[tuple[int, int], FloatArray, FloatArray]  # floor and ceiling, level distances, and clarity of walls


class _Around(NamedTuple):
    """A view, what it shows, and the pairs of level planes that may be floor and ceiling, best first."""

    view: PlaneView
    sky: Skyline
    rooms: list[tuple[int, int]]


def _around(view: PlaneView, planes: Sequence[ScenePlane]) -> _Around:
    sky = skyline(blurred(view.load()), view.cam_from_world)
    return _Around(view, sky, _rooms(planes, view.cam_from_world.center))


def _rooms(planes: Sequence[ScenePlane], center: FloatArray) -> list[tuple[int, int]]:
    """Return the pairs of a level plane below the centre and one above it, those with most support first."""
    floors, ceilings = (
        [
            idx
            for idx, plane in enumerate(planes)
            if plane.is_level and sign * (plane.y - center[1]) > 0 > sign * plane.normal[1]
        ]
        for sign in (1, -1)
    )
    pairs = [(floor, ceiling) for floor in floors for ceiling in ceilings]
    return sorted(pairs, key=lambda pair: -planes[pair[0]].support * planes[pair[1]].support)[:6]


def _clearest(tried: Sequence[_Tried]) -> _Tried:
    """Return the first of some rooms whose creases are nearly as clear as those of the clearest.

    A room and a smaller one of the same shape look the same in one view, so that support decides.
    """
    totals = [float(np.maximum(clarity.max(axis=0), 0).sum()) for _, _, clarity in tried]
    return next(found for found, total in zip(tried, totals, strict=True) if total >= 0.95 * max(totals))


def _coarsely(views: Sequence[PlaneView], planes: Sequence[ScenePlane]) -> list[_Around]:
    """Return some views at a quarter of the azimuths."""
    around = [_around(view, planes) for view in views[:: -(-len(views) // _TURN_VIEWS)]]
    return [one._replace(sky=Skyline(one.sky.differences[:, ::_TURN_STEP], half_window=1)) for one in around]


def _turn(around: Sequence[_Around], planes: Sequence[ScenePlane]) -> float:
    """Return the turn of the four directions whose walls are clearest around some views."""
    turn = max(_TURNS_RAD, key=lambda turn: _total(around, planes, turn))
    return float(turn + max(_FINE_TURNS_RAD, key=lambda more: _total(around, planes, turn + more)))


def _total(around: Sequence[_Around], planes: Sequence[ScenePlane], turn: float) -> float:
    """Return how clear the creases of the clearest walls of four directions are around some views."""
    total = 0.0
    for one in around:
        clarity = np.maximum(_search(one, planes, one.rooms[0], turn=turn)[1], 0)
        total += float(_along(clarity[..., None], _TURN_SPAN // 2).max(axis=0).sum())
    return total


def _heights(one: _Around, planes: Sequence[ScenePlane], room: tuple[int, int]) -> tuple[float, float]:
    y = float(one.view.cam_from_world.center[1])
    return planes[room[0]].y - y, y - planes[room[1]].y


def _search(
    one: _Around, planes: Sequence[ScenePlane], room: tuple[int, int], *, turn: float
) -> tuple[FloatArray, FloatArray]:
    """Return level distances (L, A) of walls of four directions, and how clear their creases are."""
    down, up = _heights(one, planes, room)
    cosine = np.cos(one.sky.azimuths_rad - turn - np.radians([[0.0], [90.0], [180.0], [270.0]]))
    seen = np.where(cosine > _LEAST_COSINE, cosine, np.nan)
    distance = (down * _DISTANCES[:, None] / seen[:, None]).reshape(-1, cosine.shape[1])
    return distance, one.sky.clarity(distance, down=down, up=up)


def _known_walls(one: _Around, planes: Sequence[ScenePlane], room: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return level distances (L, A) of the upright planes, and how clearly creases and ranges show them."""
    upright = [plane for plane in planes if not plane.is_level]
    if not upright:
        return np.empty((0, _AZIMUTHS)), np.empty((0, _AZIMUTHS))
    down, up = _heights(one, planes, room)
    center = one.view.cam_from_world.center
    distance = np.array([_level_distance(plane, center, one.sky.azimuths_rad) for plane in upright])
    clear = one.sky.clarity(distance, down=down, up=up)
    return distance, clear + 2 * np.array([_confirmed(one.view, plane, down=down, up=up) for plane in upright])


def _walls_of(one: _Around, planes: Sequence[ScenePlane], turn: float) -> list[tuple[float, ScenePlane, FloatArray]]:
    """Return the walls of a view that are clearer than those at other distances, with weights and the centre."""
    center = one.view.cam_from_world.center
    room, distance, clarity = _clearest([(room, *_search(one, planes, room, turn=turn)) for room in one.rooms])
    down, up = _heights(one, planes, room)
    searched, (known, known_clarity) = len(distance), _known_walls(one, planes, room)
    distance, clarity = np.concatenate([distance, known]), np.concatenate([clarity, known_clarity])
    label = best_walls(clarity, distance)
    found = []
    for start, end in _pieces(label):
        azimuths = np.arange(start, end) % len(label)
        wall = int(label[azimuths[0]])
        if not 0 <= wall < searched:
            continue
        direction = turn + wall // len(_DISTANCES) * np.pi / 2
        normal = -np.array([np.sin(direction), 0.0, np.cos(direction)])
        offset = float(normal @ center) - down * float(_DISTANCES[wall % len(_DISTANCES)])
        plane = ScenePlane(normal, offset, 0.0, 0.0, uncertainty=OUTLINE_UNCERTAINTY, is_level=False)
        with np.errstate(invalid="ignore"):
            apart = np.abs(np.log(distance[:, azimuths] / distance[wall, azimuths]))
        other = np.where(np.isfinite(apart) & (apart > _STEP_SIZE), clarity[:, azimuths], 0.0)
        margin = float(clarity[wall, azimuths].mean() - other.mean(axis=1).max())
        margin += 2 * float(_confirmed(one.view, plane, down=down, up=up)[azimuths].mean())
        if margin > 0.1:
            found.append((margin * len(azimuths), plane, center))
    return found


def _confirmed(view: PlaneView, wall: ScenePlane, *, down: float, up: float) -> FloatArray:
    """Return the share of a wall at each azimuth that confirmed ranges are on, less the share they see through.

    `down`, `up`: to the floor, and to the ceiling.
    """
    on_wall = plane_ranges(view.rays, view.cam_from_world.center, normal=wall.normal, offset=wall.offset)
    with np.errstate(invalid="ignore"):
        height = on_wall * view.rays[..., 1]
        between = (height < down) & (height > -up)
        ratio = view.ranges / on_wall
        votes = 1.0 * (np.abs(ratio - 1) < _SAME_DISTANCE) - (ratio > 1 + _SAME_DISTANCE)
    votes *= view.confidence >= CONSISTENT_CONFIDENCE[0]
    azimuth = azimuths_of(view.rays)[between]
    area, voted = (
        np.bincount(azimuth, weights=weight[between], minlength=_AZIMUTHS) for weight in (view.area, view.area * votes)
    )
    return np.asarray(voted / np.maximum(area, 1e-12))


def azimuths_of(rays: FloatArray) -> Labels:
    """Return the column of an outline of rays (..., 3) in the world."""
    azimuth = np.arctan2(rays[..., 0], rays[..., 2]) * _AZIMUTHS / (2 * np.pi)
    return np.asarray(azimuth.round().astype(np.int64) % _AZIMUTHS)


def _pieces(label: Labels) -> list[tuple[int, int]]:
    """Return the first azimuth of each run of equal labels, and the one after its last, which may be beyond the end."""
    starts = np.flatnonzero(label != np.roll(label, 1))
    if not len(starts):
        return [(0, len(label))]
    return list(zip(starts.tolist(), [*starts[1:].tolist(), int(starts[0]) + len(label)], strict=True))


def same_wall(plane: ScenePlane, other: ScenePlane, centers: FloatArray) -> bool:
    """Return whether two upright planes are one, from the nearest of some centres (N, 3) before the first."""
    heights, others = centers @ plane.normal - plane.offset, centers @ other.normal - other.offset
    if heights.max() <= 0 or plane.normal @ other.normal < np.cos(_SAME_RAD):
        return False
    nearest = np.argmin(np.where(heights > 0, heights, np.inf))
    return bool(abs(others[nearest] / heights[nearest] - 1) < _SAME_DISTANCE)


def _level_distance(plane: ScenePlane, center: FloatArray, azimuths_rad: FloatArray) -> FloatArray:
    """Return the level distance to an upright plane at each azimuth, (A,), NaN where it is not seen."""
    cosine = np.sin(azimuths_rad) * plane.normal[0] + np.cos(azimuths_rad) * plane.normal[2]
    height = plane.offset - center @ plane.normal
    with np.errstate(divide="ignore"):
        return np.where((cosine < -_LEAST_COSINE) & (height < 0), height / cosine, np.nan)


def _along(values: NDArray[Any], half_window: int) -> NDArray[Any]:
    """Return the means of values (L, A, C) around each azimuth."""
    around = np.concatenate([values[:, -half_window:], values, values[:, :half_window]], axis=1)
    means = cv2.blur(around.reshape(*around.shape[:2], -1), (2 * half_window + 1, 1))
    return np.asarray(means).reshape(around.shape)[:, half_window:-half_window]
