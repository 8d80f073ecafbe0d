"""Place planes by creases: the lines where upright planes meet level ones.

Plain walls show nothing to match, but their lower and upper edges do. In every view, the picture is sampled across the
predicted crease, at many azimuths. A plane is placed where differences of colour across the crease have most in common:
they are added as vectors, so that texture beside the crease cancels out and the crease remains. All views, and the
creases with all level planes, count together. The level plane that is best confirmed by matches is kept; the others
move, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.algorithms.structure.outline import room_labels, room_of
from pano_mvs.algorithms.structure.view import (
    HALF_DIFFERENCE,
    STEP_RAD,
    PlaneView,
    ScenePlane,
    blurred,
    differences,
    plane_ranges,
    world_rays,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

# Profiles across a crease: steps to either side.
_REACH = 45
_AZIMUTHS_RAD = np.radians(np.arange(0.0, 360.0, 0.7))
_COARSE_STEPS = 2
# The planes must be seen on their sides of the crease, this far from it.
_BESIDE_RAD = np.radians([2.0, 3.5])

# Standard deviations of the shift and the turn of planes that were fitted to precise points, and to others.
_PRECISE_STDS, _PLAIN_STDS = np.array([0.002, np.radians(0.1)]), np.array([0.02, np.radians(0.7)])
# The loss of a shift by one standard deviation, as a share of the contrast across the crease.
_LOSS = 0.025
_COARSE_SHIFTS, _COARSE_TURNS_RAD = np.linspace(-0.06, 0.06, 25), np.radians(np.linspace(-1, 1, 5))
_FINE_SHIFTS, _FINE_TURNS_RAD = np.linspace(-0.004, 0.004, 9), np.radians(np.linspace(-0.3, 0.3, 5))
_HEIGHT_SHIFTS = np.linspace(-0.01, 0.01, 21)


def placed_by_creases(
    views: Sequence[PlaneView], planes: Sequence[ScenePlane], *, max_relative_error: float
) -> list[ScenePlane]:
    """Return the planes, in the same order, moved to where the pictures show their creases.

    Planes without support that show no clear ones are left out. `views`: of one group, in whose world y points down
    along gravity. `planes`: found in ranges and outlines. `max_relative_error`: of ranges on a plane.
    """
    creases = _creases(views, planes, max_relative_error)
    heights = np.array([plane.y if plane.is_level else np.nan for plane in planes])
    placed = {idx: _Placement(planes[idx], of_plane) for idx, of_plane in sorted(creases.items())}
    for placement in placed.values():
        placement.move(heights, _COARSE_SHIFTS, _COARSE_TURNS_RAD, fine=False)
    levels = sorted(
        (idx for idx, plane in enumerate(planes) if plane.is_level), key=lambda idx: -planes[idx].precise_support
    )
    for round_number in range(3):
        for placement in placed.values():
            placement.move(heights, _FINE_SHIFTS / (1 + round_number), _FINE_TURNS_RAD / (1 + round_number), fine=True)
        for level in levels[1:]:
            heights[level] = _best_height(planes[level], level, heights, placed=list(placed.values()))
    clear = {idx: placement for idx, placement in placed.items() if placement.share >= 0.25}
    return [
        replace(plane, offset=float(heights[idx] * plane.normal[1]))
        if plane.is_level
        else clear[idx].result()
        if idx in clear
        else plane
        for idx, plane in enumerate(planes)
        if plane.is_level or plane.support or idx in clear
    ]


@dataclass(frozen=True, eq=False)
class _Creases:
    """The samples of all creases of one upright plane.

    `azimuth`: (S,) in the world. `dip`: (S,) angle below the horizon at which each profile has its middle. `center`:
    (S, 3) of the camera. `level`: (S,) the level plane that it meets. `starts`: first sample of each crease of one
    view. `fine`: (S, 2 reach + 1, 3) differences of colours across the crease, at each step below the middle. `coarse`:
    the same, blurred along the profile.
    """

    azimuth: FloatArray
    dip: FloatArray
    center: FloatArray
    level: NDArray[np.int64]
    starts: NDArray[np.int64]
    fine: FloatArray
    coarse: FloatArray


class _Placement:
    """The search for the place of one upright plane: a turn about its middle, and a relative shift."""

    def __init__(self, plane: ScenePlane, creases: _Creases) -> None:
        self.plane, self.creases = plane, creases
        across = np.stack([np.sin(creases.azimuth), np.cos(creases.azimuth)], axis=-1)
        normal = plane.normal[[0, 2]]
        self._height = plane.offset - creases.center[:, [0, 2]] @ normal
        self._across = across
        self._stds = plane.precise_share * _PRECISE_STDS + (1 - plane.precise_share) * _PLAIN_STDS
        foot = creases.center[:, [0, 2]] + across * (self._height / (across @ normal))[:, None]
        self._middle = foot.mean(axis=0)
        self._distance = float(np.abs(self._height).mean())
        self._most = [
            max(float(np.sqrt((profiles**2).sum(axis=-1).max(axis=1)).sum()), 1e-9)
            for profiles in (creases.coarse, creases.fine)
        ]
        self.turn = self.shift = 0.0
        self.share = 0.0

    def move(
        self, heights: FloatArray, shifts: NDArray[np.floating], turns: NDArray[np.floating], *, fine: bool
    ) -> None:
        """Move the plane to the best of some shifts and turns relative to its present place."""
        _, self.turn, self.shift = max(
            (self.score(heights, turn, shift, fine=fine), turn, shift)
            for turn in self.turn + turns
            for shift in self.shift + shifts
        )
        self.share = self.score(heights, self.turn, self.shift, fine=fine)

    def score(self, heights: FloatArray, turn: float, shift: float, *, fine: bool = True) -> float:
        """Return the share of the contrast that lies on the predicted creases, less the loss of the prior."""
        normal, offset = self._moved(turn, shift)
        creases = self.creases
        center = creases.center
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (offset - center[:, [0, 2]] @ normal) / (self._across @ normal)
        dip = np.arctan2(heights[creases.level] - center[:, 1], distance)
        place = (dip - creases.dip) / STEP_RAD + _REACH
        inside = (distance > 0) & (place >= 0) & (place < 2 * _REACH)
        place = np.where(inside, place, 0.0)
        first = place.astype(np.int64)
        part = (place - first)[:, None]
        profiles = creases.fine if fine else creases.coarse
        samples = np.arange(len(first))
        values = profiles[samples, first] * (1 - part) + profiles[samples, first + 1] * part
        common = np.add.reduceat(values * inside[:, None], creases.starts, axis=0)
        share = float(np.sqrt((common**2).sum(axis=-1)).sum() / self._most[fine])
        shift_std, turn_std = self._stds
        return float(share - _LOSS * ((shift / shift_std) ** 2 + (turn / turn_std) ** 2))

    def result(self) -> ScenePlane:
        """Return the plane at its place."""
        (x, z), offset = self._moved(self.turn, self.shift)
        uncertainty = self.plane.uncertainty
        if self.plane.support:  # ranges and creases agree
            # Standard deviation of ranges on planes that creases placed.
            uncertainty = min(uncertainty, 0.004)
        return replace(self.plane, normal=np.array([x, 0.0, z]), offset=offset, uncertainty=uncertainty)

    def _moved(self, turn: float, shift: float) -> tuple[FloatArray, float]:
        x, z = self.plane.normal[[0, 2]]
        normal = np.array([x * np.cos(turn) - z * np.sin(turn), x * np.sin(turn) + z * np.cos(turn)])
        return normal, float(self._middle @ normal + shift * self._distance)


def _best_height(plane: ScenePlane, level: int, heights: FloatArray, *, placed: Sequence[_Placement]) -> float:
    """Return the height of a level plane at which the creases of all upright planes fit best, each moved to it."""
    meeting = [placement for placement in placed if (placement.creases.level == level).any()]
    if not meeting:
        return float(heights[level])
    middle = np.concatenate([placement.creases.center[:, 1] for placement in meeting]).mean()
    samples = sum(len(placement.creases.azimuth) for placement in meeting)
    # Standard deviations of the height of level planes that were fitted to precise points, and to others, relative to
    # that above or below the cameras.
    std = plane.precise_share * 0.001 + (1 - plane.precise_share) * 0.005
    best, found = -np.inf, float(heights[level])
    for shift in _HEIGHT_SHIFTS:
        tried = heights.copy()
        tried[level] += shift * (heights[level] - middle)
        moved = (tried[level] - plane.y) / (plane.y - middle)
        total = sum(
            len(placement.creases.azimuth)
            * max(placement.score(tried, placement.turn, placement.shift + own) for own in _FINE_SHIFTS[::2])
            for placement in meeting
        )
        total -= samples * _LOSS * (moved / std) ** 2
        if total > best:
            best, found = total, float(tried[level])
    return found


def _creases(views: Sequence[PlaneView], planes: Sequence[ScenePlane], tolerance: float) -> dict[int, _Creases]:
    """Return the creases of each upright plane that has any."""
    parts: dict[int, list[tuple[FloatArray, ...]]] = {}
    for view in views:
        labels = _shown_planes(view, planes, tolerance)
        picture = blurred(view.load())
        for idx, upright in enumerate(planes):
            for level, other in enumerate(planes):
                if upright.is_level or not other.is_level:
                    continue
                found = _profiles(view, upright, other.y, picture=picture, sides=(labels == idx, labels == level))
                if found is not None:
                    azimuth, dip, differences = found
                    center = np.broadcast_to(view.cam_from_world.center, (len(azimuth), 3))
                    parts.setdefault(idx, []).append((azimuth, dip, center, np.full(len(azimuth), level), differences))
    return {idx: _joined(of_plane) for idx, of_plane in parts.items()}


def _joined(parts: Sequence[tuple[FloatArray, ...]]) -> _Creases:
    azimuth, dip, center, level, fine = (np.concatenate(column) for column in zip(*parts, strict=True))
    sizes = [len(part[0]) for part in parts]
    spread = np.arange(-3 * _COARSE_STEPS, 3 * _COARSE_STEPS + 1) / _COARSE_STEPS
    kernel = np.exp(-(spread**2) / 2)
    rows = fine.reshape(*fine.shape[:2], 3).astype(np.float32)
    coarse = cv2.sepFilter2D(rows, -1, (kernel / kernel.sum())[None, ::-1], np.ones(1))
    starts = np.cumsum([0, *sizes[:-1]])
    return _Creases(azimuth, dip, center, level.astype(np.int64), starts, fine, coarse.astype(np.float64))


def _shown_planes(view: PlaneView, planes: Sequence[ScenePlane], tolerance: float) -> NDArray[np.int64]:
    """Return the plane of each pixel, (h, w), −1 for none: by its range if confirmed, else by the room's outline."""
    center = view.cam_from_world.center
    ranges = [plane_ranges(view.rays, center, normal=plane.normal, offset=plane.offset) for plane in planes]
    best = np.full(view.ranges.shape, tolerance)
    labels = np.full(view.ranges.shape, -1)
    for idx, of_plane in enumerate(ranges):
        with np.errstate(invalid="ignore"):
            error = np.abs(of_plane / view.ranges - 1)
            closer = error < best
        best[closer], labels[closer] = error[closer], idx
    room = room_of(view, planes)
    if room is None:
        return labels
    outlined = room_labels(room, view.rays, ranges)
    return np.where((outlined >= 0) & (view.confidence < CONSISTENT_CONFIDENCE[0]), outlined, labels)


def _profiles(
    view: PlaneView,
    upright: ScenePlane,
    level_y: float,
    *,
    picture: NDArray[np.float32],
    sides: tuple[NDArray[np.bool_], NDArray[np.bool_]],
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return azimuths (S,), dips (S,) and differences of colour (S, 2 reach + 1, 3) of a crease; None if not seen.

    `view`: the view. `upright`: the upright plane. `level_y`: height of the level one. `picture`: the panorama, padded
    and blurred. `sides`: (h, w) pixels that show the upright plane, and the level one.
    """
    center = view.cam_from_world.center
    across = np.stack([np.sin(_AZIMUTHS_RAD), np.cos(_AZIMUTHS_RAD)], axis=-1)
    cosine, height = across @ upright.normal[[0, 2]], upright.offset - center @ upright.normal
    if height >= 0:
        return None
    seen = cosine < -0.08
    azimuth = _AZIMUTHS_RAD[seen]
    dip = np.arctan2(level_y - center[1], height / cosine[seen])
    outward = -np.sign(level_y - center[1])  # towards the horizon, where the upright plane is
    shown = np.zeros(len(azimuth), np.bool_)
    for beside in _BESIDE_RAD:
        on_upright = _value_at(sides[0], view, rays=world_rays(azimuth, dip + outward * beside))
        on_level = _value_at(sides[1], view, rays=world_rays(azimuth, dip - outward * beside))
        shown |= on_upright & on_level
    if shown.sum() < 6:
        return None
    azimuth, dip = azimuth[shown], dip[shown]
    steps = STEP_RAD * np.arange(-_REACH - HALF_DIFFERENCE, _REACH + HALF_DIFFERENCE + 1)
    rays = world_rays(azimuth[:, None], dip[:, None] + steps) @ view.cam_from_world.rotation.T
    return azimuth, dip, differences(picture, rays, axis=1).astype(np.float64)


def _value_at(values: NDArray[np.bool_], view: PlaneView, *, rays: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(values[pixels_containing(rays @ view.cam_from_world.rotation.T, values.shape)])
