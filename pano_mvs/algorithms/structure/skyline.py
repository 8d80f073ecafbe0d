"""What a view shows of the creases around it, and how clear those of walls of four directions are.

Colours across a crease are compared as vectors, in the mean of some degrees along it, so that texture cancels out. The
upper edge of a skirting board is often clearer than the crease below it, so that edges above the crease with the floor
count for it, and edges below it against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.structure.view import (
    AZIMUTHS,
    HALF_DIFFERENCE,
    STEP_RAD,
    PlaneView,
    ScenePlane,
    blurred,
    differences,
    world_rays,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3

LEAST_COSINE = 0.1
"""Least cosine of the angle between a level ray and the normal of a wall that is seen."""
_HALF_WINDOW = 4  # azimuths along a crease
CLEAR_LEVELS = 20.0
"""A difference of colour that could not be clearer."""
# Heights above the floor of the upper edges of skirting boards, in heights of the camera. Edges are others than the
# crease at angles that the differences of colour resolve.
_SKIRTINGS, _APART_RAD = (0.04, 0.06, 0.08), 2 * HALF_DIFFERENCE * STEP_RAD
DISTANCES = np.geomspace(0.35, 9.0, 110)
"""The distances of the walls of a search, in heights of the camera above the floor."""
_TURNS_RAD, _FINE_TURNS_RAD = np.radians(np.arange(0.0, 90.0, 3.0)), np.radians(np.arange(-2.0, 2.1, 1.0))
# The turn of the four directions is searched at every fourth azimuth of some views, with planes that are clear over
# 36°.
TURN_VIEWS = 6
"""Views in which the turn of the four directions is searched."""
_TURN_STEP, _TURN_SPAN = 4, 9


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

        `down`, `up`: heights of the camera above the floor, and of the ceiling above the camera. Skirting boards count
        beyond these limits.
        """
        return self.crease_clarity(distance, -down) + self.crease_clarity(distance, up)

    def crease_clarity(self, distance: FloatArray, height: float) -> FloatArray:
        """Return how clear one crease of walls is, at a height above the camera that is negative for the floor."""
        columns = _arcs(np.isfinite(distance), self.half_window)
        rows = np.arange(len(distance))[:, None]
        result = np.full(distance.shape, -np.inf, np.float32)
        distance = distance[rows, columns]
        seen = np.isfinite(distance)
        distance = np.where(seen, distance, 1.0)
        elevation, other = np.arctan2(height, distance), []
        clear = self._edge_clarity(elevation, seen, columns)
        if height < 0:
            for sign in (1, -1):
                clearest = np.zeros(clear.shape)
                for part in _SKIRTINGS:
                    beside = np.arctan2(height * (1 - sign * part), distance)
                    counted = seen & (np.abs(beside - elevation) > _APART_RAD)
                    clearest = np.maximum(clearest, self._edge_clarity(beside, counted, columns))
                other.append(clearest)
            clear *= (1 + other[0] - other[1]).astype(np.float32)
        result[rows, columns] = np.where(seen, clear, -np.inf)
        return np.asarray(result)

    def _edge_clarity(
        self, elevation: FloatArray, counted: NDArray[np.bool_], columns: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Return how clear the edges of walls at elevations (L, N) are, from 0 to 1; 0 where they do not count."""
        common = mean_along(self._at(elevation, columns) * counted[..., None], self.half_window)
        red, green, blue = np.moveaxis(common, -1, 0)  # nine times as fast as `np.linalg.norm`
        return np.asarray(np.sqrt(np.minimum(np.sqrt(red * red + green * green + blue * blue) / CLEAR_LEVELS, 1.0)))

    def _at(self, elevation: FloatArray, columns: NDArray[np.int64]) -> NDArray[np.float32]:
        place = (elevation + np.pi / 2) / STEP_RAD
        first = np.clip(place.astype(np.int64), 0, len(self.differences) - 2)
        part = (place - first)[..., None].astype(np.float32)
        width = self.differences.shape[1]
        flat, index = self.differences.reshape(-1, 3), first * width + columns
        return np.asarray(flat.take(index, axis=0) * (1 - part) + flat.take(index + width, axis=0) * part)


def _arcs(seen: NDArray[np.bool_], half_window: int) -> NDArray[np.int64]:
    """Return azimuths (L, N) with all that are seen (L, A), and half a window of others from the last to the first.

    All azimuths if what is seen is not one arc in each row.
    """
    starts, count = seen & ~np.roll(seen, 1, axis=1), int(seen.sum(axis=1).max(initial=0)) + half_window
    if count >= seen.shape[1] or (starts.sum(axis=1) > 1).any():
        return np.broadcast_to(np.arange(seen.shape[1]), seen.shape)
    return np.asarray((starts.argmax(axis=1)[:, None] + np.arange(count)) % seen.shape[1])


def skyline(picture: NDArray[np.float32], cam_from_world: Rigid3, step: int = 1) -> Skyline:
    """Return how colours of a panorama from `blurred` change with the elevation, in a world with y down.

    `step`: 1 for all azimuths; otherwise every n-th is sampled, with a window of one to either side.
    """
    dip = np.pi / 2 - STEP_RAD * np.arange(round(np.pi / STEP_RAD) + 1)[:, None]
    rays = world_rays(np.linspace(0, 2 * np.pi, AZIMUTHS // step, endpoint=False), dip) @ cam_from_world.rotation.T
    changes = differences(picture, rays, axis=0)
    # The tails of one edge must not be taken for other edges.
    size = np.linalg.norm(changes, axis=-1)
    around = cv2.dilate(size, np.ones((4 * HALF_DIFFERENCE + 1, 1), np.uint8))
    changes *= ((size / np.maximum(around, 1e-6)) ** 2 / np.maximum(around / CLEAR_LEVELS, 1.0))[..., None]
    padded = np.pad(changes, [((len(dip) - len(changes)) // 2,) * 2, (0, 0), (0, 0)])
    return Skyline(padded, half_window=_HALF_WINDOW if step == 1 else 1)


class Around(NamedTuple):
    """A view, what it shows, and the pairs of level planes that may be floor and ceiling, best first."""

    view: PlaneView
    sky: Skyline
    rooms: list[tuple[int, int]]


def around_view(view: PlaneView, planes: Sequence[ScenePlane], step: int = 1) -> Around:
    """Return what a view shows of creases, with the rooms that planes make possible."""
    sky = skyline(blurred(view.load()), view.cam_from_world, step)
    return Around(view, sky, possible_rooms(planes, view.cam_from_world.center))


def possible_rooms(planes: Sequence[ScenePlane], center: FloatArray) -> list[tuple[int, int]]:
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


def coarsely_around(views: Sequence[PlaneView], planes: Sequence[ScenePlane], count: int) -> list[Around]:
    """Return about a count of views at a quarter of the azimuths."""
    return [around_view(view, planes, _TURN_STEP) for view in views[:: -(-len(views) // count)]]


def clearest_turn(around: Sequence[Around], planes: Sequence[ScenePlane]) -> float:
    """Return the turn of the four directions whose walls are clearest around some views."""
    turn = max(_TURNS_RAD, key=lambda turn: _total(around, planes, turn))
    return float(turn + max(_FINE_TURNS_RAD, key=lambda more: _total(around, planes, turn + more)))


def _total(around: Sequence[Around], planes: Sequence[ScenePlane], turn: float) -> float:
    """Return how clear the creases of the clearest walls of four directions are around some views."""
    return sum(clearest_total(search_walls(one, planes, one.rooms[0], turn=turn)[1]) for one in around)


def clearest_total(clarity: FloatArray) -> float:
    """Return the sum over the azimuths of the clearest of some walls, (L, A), in the mean of 36° along it."""
    return float(mean_along(np.maximum(clarity, 0)[..., None], _TURN_SPAN // 2).max(axis=0).sum())


def room_heights(one: Around, planes: Sequence[ScenePlane], room: tuple[int, int]) -> tuple[float, float]:
    """Return the heights of the camera above the floor of a room, and of its ceiling above the camera."""
    y = float(one.view.cam_from_world.center[1])
    return planes[room[0]].y - y, y - planes[room[1]].y


def search_walls(
    one: Around, planes: Sequence[ScenePlane], room: tuple[int, int], *, turn: float
) -> tuple[FloatArray, FloatArray]:
    """Return level distances (L, A) of walls of four directions, and how clear their creases are."""
    down, up = room_heights(one, planes, room)
    distance = wall_distances(one.sky, turn, down * DISTANCES)
    return distance, one.sky.clarity(distance, down=down, up=up)


def wall_distances(sky: Skyline, turn: float, tried: FloatArray) -> FloatArray:
    """Return level distances (L, A) to walls of four directions at tried distances, NaN where they are not seen."""
    cosine = np.cos(sky.azimuths_rad - turn - np.radians([[0.0], [90.0], [180.0], [270.0]]))
    seen = np.where(cosine > LEAST_COSINE, cosine, np.nan)
    return np.asarray((tried[:, None] / seen[:, None]).reshape(-1, cosine.shape[1]))


def mean_along(values: NDArray[Any], half_window: int) -> NDArray[Any]:
    """Return the means of values (L, A, C) around each azimuth."""
    around = np.concatenate([values[:, -half_window:], values, values[:, :half_window]], axis=1)
    means = cv2.blur(around.reshape(*around.shape[:2], -1), (2 * half_window + 1, 1))
    return np.asarray(means).reshape(around.shape)[:, half_window:-half_window]
