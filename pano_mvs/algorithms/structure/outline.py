"""Find the outline of the room around each view by the lines where its walls meet floor and ceiling.

The heights of floor and ceiling are known, so that the distance of a wall predicts both of its creases, and one picture
is enough. Among upright planes, each azimuth gets the one whose creases the picture shows best, with few changes from
azimuth to azimuth (dynamic programming, after A. Flint, D. Murray, I. Reid, "Manhattan scene understanding using
monocular, stereo, and 3D features", ICCV 2011, section 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.structure.skyline import (
    DISTANCES,
    LEAST_COSINE,
    TURN_VIEWS,
    Around,
    around_view,
    clearest_turn,
    coarsely_around,
    possible_rooms,
    room_heights,
    search_walls,
)
from pano_mvs.algorithms.structure.view import AZIMUTHS, PlaneView, ScenePlane, azimuths_of, plane_ranges
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.bands import mapped
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

Labels = NDArray[np.int64]

# The cost of a change of plane and of each relative step in distance there, in azimuths of clear creases.
_CHANGE, _STEP_SIZE, _MOST_STEPS = 2.0, 0.1, 3.0
_SAME_RAD, _SAME_DISTANCE = np.radians(4.0), 0.05
OUTLINE_UNCERTAINTY = 0.03
"""Relative standard deviation of ranges on a wall that creases of single views alone show."""

_Tried = tuple[tuple[int, int], FloatArray, FloatArray]  # floor and ceiling, level distances, and clarity of walls


class Room(NamedTuple):
    """The room around a view.

    `floor`, `ceiling`: positions of level planes. `walls`: (360,) position of the plane at each azimuth, −1 for none.
    """

    floor: int
    ceiling: int
    walls: Labels


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
    one = around_view(view, planes)
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


def outline_planes(views: Sequence[PlaneView], planes: Sequence[ScenePlane], *, threads: int = 1) -> list[ScenePlane]:
    """Return upright planes that outlines show and that are not among `planes`, which have the level ones."""
    indoors = [view for view in views if possible_rooms(planes, view.cam_from_world.center)]
    if not indoors:
        return []
    turn = clearest_turn(coarsely_around(indoors, planes, TURN_VIEWS), planes)
    walls = mapped(lambda view: _walls_of(around_view(view, planes), planes, turn), indoors, threads=threads)
    found: list[ScenePlane] = []
    for _, wall, center in sorted((wall for of_view in walls for wall in of_view), key=lambda wall: -wall[0]):
        if not any(same_wall(wall, other, center[None]) for other in (*planes, *found)):
            found.append(wall)
    return found


def _clearest(tried: Sequence[_Tried]) -> _Tried:
    """Return the first of some rooms whose creases are nearly as clear as those of the clearest.

    A room and a smaller one of the same shape look the same in one view, so that support decides.
    """
    totals = [float(np.maximum(clarity.max(axis=0), 0).sum()) for _, _, clarity in tried]
    return next(found for found, total in zip(tried, totals, strict=True) if total >= 0.95 * max(totals))


def _known_walls(one: Around, planes: Sequence[ScenePlane], room: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return level distances (L, A) of the upright planes, and how clearly creases and ranges show them."""
    upright = [plane for plane in planes if not plane.is_level]
    if not upright:
        return np.empty((0, AZIMUTHS)), np.empty((0, AZIMUTHS))
    down, up = room_heights(one, planes, room)
    center = one.view.cam_from_world.center
    distance = np.array([_level_distance(plane, center, one.sky.azimuths_rad) for plane in upright])
    clear = one.sky.clarity(distance, down=down, up=up)
    return distance, clear + 2 * np.array([_confirmed(one.view, plane, down=down, up=up) for plane in upright])


def _walls_of(one: Around, planes: Sequence[ScenePlane], turn: float) -> list[tuple[float, ScenePlane, FloatArray]]:
    """Return the walls of a view that are clearer than those at other distances, with weights and the centre."""
    center = one.view.cam_from_world.center
    room, distance, clarity = _clearest([(room, *search_walls(one, planes, room, turn=turn)) for room in one.rooms])
    down, up = room_heights(one, planes, room)
    searched, (known, known_clarity) = len(distance), _known_walls(one, planes, room)
    distance, clarity = np.concatenate([distance, known]), np.concatenate([clarity, known_clarity])
    label = best_walls(clarity, distance)
    found = []
    for start, end in pieces(label):
        azimuths = np.arange(start, end) % len(label)
        wall = int(label[azimuths[0]])
        if not 0 <= wall < searched:
            continue
        direction = turn + wall // len(DISTANCES) * np.pi / 2
        normal = -np.array([np.sin(direction), 0.0, np.cos(direction)])
        offset = float(normal @ center) - down * float(DISTANCES[wall % len(DISTANCES)])
        plane = ScenePlane(normal, offset, 0.0, uncertainty=OUTLINE_UNCERTAINTY, is_level=False)
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
    azimuth = view.azimuth[between]
    area, voted = (
        np.bincount(azimuth, weights=weight[between], minlength=AZIMUTHS) for weight in (view.area, view.area * votes)
    )
    return np.asarray(voted / np.maximum(area, 1e-12))


def pieces(label: Labels) -> list[tuple[int, int]]:
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
        return np.where((cosine < -LEAST_COSINE) & (height < 0), height / cosine, np.nan)
