"""Place planes by creases: the lines where upright planes meet level ones.

Plain walls show nothing to match, but their lower and upper edges do. In every view, the picture is sampled across the
predicted crease, at many azimuths. Each upright plane is first moved to where differences of colour across its creases
have most in common: they are added as vectors, so that texture beside the crease cancels out and the crease remains.
Then the places of short pieces of all creases of all views are measured, and all planes are adjusted to them together,
each held by its ranges according to their uncertainty. Views at different distances from a wall locate the edge that
they see, which need not be where the planes meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.algorithms.structure.outline import room_labels, room_of, same_wall
from pano_mvs.algorithms.structure.skyline import CLEAR_LEVELS
from pano_mvs.algorithms.structure.view import (
    HALF_DIFFERENCE,
    LEAST_UNCERTAINTY,
    STEP_RAD,
    PlaneView,
    ScenePlane,
    blurred,
    differences,
    plane_ranges,
    world_rays,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.bands import mapped
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

# Profiles across a crease: steps to either side.
_REACH = 45
_AZIMUTHS_RAD = np.radians(np.arange(0.0, 360.0, 0.7))
_COARSE_STEPS = 2
# The planes must be seen on their sides of the crease, this far from it.
_BESIDE_RAD = np.radians([2.0, 3.5])

# A shift by one standard deviation costs about this share of the contrast across the crease, and larger ones less than
# its square: Cauchy weights begin to fall at as many standard deviations.
_LOSS, _TAIL = 0.025, 2.0
_SHIFTS, _TURNS_RAD = np.linspace(-0.06, 0.06, 25), np.radians(np.linspace(-1, 1, 5))
# Pieces of creases have at most as many samples. In three rendered captures with true planes, they scattered by 0.02 to
# 0.05° around what the creases of two planes have in common, and this was 0.02° (hall) to 0.3° (skirting boards of a
# small room) from the truth. The last scale of the search, from coarse to fine, is that of the errors that pieces of
# one view have in common; pieces are sought within five times a scale.
_PIECE, _PIECE_RAD, _SCALES_RAD = 12, np.radians(0.05), np.radians([0.2, 0.14, 0.1, 0.08, 0.06, 0.06])


def placed_by_creases(
    views: Sequence[PlaneView], planes: Sequence[ScenePlane], *, max_relative_error: float, threads: int = 1
) -> list[ScenePlane]:
    """Return the planes moved to where the pictures show their creases; level planes first.

    Planes without support that show no clear ones are left out. `views`: of one group, in whose world y points down
    along gravity. `planes`: found in ranges and outlines. `max_relative_error`: of ranges on a plane.
    `threads`: number of threads.
    """
    creases = _creases(views, planes, max_relative_error, threads=threads)
    level_distances = [_level_distance(plane, views) if plane.is_level else 0.0 for plane in planes]
    heights = np.array([plane.y if plane.is_level else np.nan for plane in planes])
    placed = {idx: _Placement(planes[idx], of_plane) for idx, of_plane in sorted(creases.items())}
    for placement in placed.values():
        placement.move(heights)
    stds = _adjust(placed, heights, planes, level_distances=level_distances)
    shares = {idx: placement.score(heights, fine=True) for idx, placement in placed.items()}
    centers = np.array([view.cam_from_world.center for view in views])
    moved: list[ScenePlane] = []
    walls: list[tuple[float, ScenePlane]] = []
    for idx, plane in enumerate(planes):
        if plane.is_level:
            offset = float(heights[idx] * plane.normal[1])
            moved.append(replace(plane, offset=offset, uncertainty=stds.get(idx, plane.uncertainty)))
        elif shares.get(idx, 0.0) >= 0.25:
            walls.append((shares[idx], placed[idx].result(stds[idx])))
        elif plane.support:
            walls.append((0.0, replace(plane, uncertainty=min(plane.uncertainty, max_relative_error))))
    # Of two that are one wall, one from an outline, that with clearer creases is kept.
    kept: list[ScenePlane] = []
    for _, wall in sorted(walls, key=lambda one: -one[0]):
        same = next(
            (
                number
                for number, other in enumerate(kept)
                if min(wall.support, other.support) == 0 and same_wall(wall, other, centers)
            ),
            None,
        )
        if same is None:
            kept.append(wall)
        elif wall.support:
            kept[same] = replace(kept[same], support=wall.support, uncertainty=wall.uncertainty)
    return moved + kept


def _level_distance(plane: ScenePlane, views: Sequence[PlaneView]) -> float:
    """Return the mean distance of a level plane from the cameras."""
    return float(np.mean([abs(plane.y - view.cam_from_world.center[1]) for view in views]))


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
    """The place of one upright plane: a turn about its middle, and a shift relative to its mean distance."""

    def __init__(self, plane: ScenePlane, creases: _Creases) -> None:
        self.plane, self.creases = plane, creases
        self._across = np.stack([np.sin(creases.azimuth), np.cos(creases.azimuth)], axis=-1)
        normal = plane.normal[[0, 2]]
        height = plane.offset - creases.center[:, [0, 2]] @ normal
        foot = creases.center[:, [0, 2]] + self._across * (height / (self._across @ normal))[:, None]
        self._middle = foot.mean(axis=0)
        self.distance = float(np.abs(height).mean())
        self._most = [
            max(float(np.sqrt((profiles**2).sum(axis=-1).max(axis=1)).sum()), 1e-9)
            for profiles in (creases.coarse, creases.fine)
        ]
        self.turn = self.shift = 0.0
        first = np.zeros(len(creases.azimuth), np.bool_)
        first[creases.starts] = True
        along = np.arange(len(first)) - np.maximum.accumulate(np.where(first, np.arange(len(first)), 0))
        self._pieces = np.flatnonzero(first | (along % _PIECE == 0))

    @property
    def azimuth(self) -> float:
        """The direction of the normal, from the z axis towards the x axis."""
        (x, z), _ = self._moved()
        return float(np.arctan2(x, z))

    @property
    def stds(self) -> FloatArray:
        """Standard deviations of the shift, relative to the distance, and of the turn, before any crease is known."""
        return np.array([1.0, 0.6]) * self.plane.uncertainty

    def move(self, heights: FloatArray) -> None:
        """Move the plane to where most of the contrast across creases is."""

        def score(place: tuple[float, float]) -> float:
            self.turn, self.shift = place
            return self.score(heights, fine=False) + _LOSS * float(
                np.log(_tail(place / self.stds[::-1])).sum() * _TAIL**2
            )

        self.turn, self.shift = max(((turn, shift) for turn in _TURNS_RAD for shift in _SHIFTS), key=score)

    def score(self, heights: FloatArray, *, fine: bool) -> float:
        """Return the share of the contrast that lies on the predicted creases."""
        place, inside = self._places(heights)
        common = np.add.reduceat(self._sampled(place, fine=fine) * inside[:, None], self.creases.starts, axis=0)
        return float(np.sqrt((common**2).sum(axis=-1)).sum() / self._most[fine])

    def measured(self, heights: FloatArray, gate_rad: float) -> tuple[FloatArray, ...]:
        """Return, for pieces of creases, how far below the predicted dip the picture shows them, and derivatives.

        Returns:
            Differences in radians (P,), contrasts in grey levels (P,), derivatives of the dip by shift, turn and the
            height of the level plane (P, 3), that plane (P,), and the number of the crease of one view (P,).
        """
        place, inside = self._places(heights)
        reach = round(gate_rad / STEP_RAD)
        steps = np.arange(-reach - 1, reach + 2)
        tried = place[:, None] + steps
        inside &= (tried[:, 0] >= 0) & (tried[:, -1] < 2 * _REACH)
        values = self._sampled(np.clip(tried, 0, 2 * _REACH - 1e-6), fine=True) * inside[:, None, None]
        counts = np.add.reduceat(inside.astype(np.float64), self._pieces)
        sums = np.add.reduceat(values, self._pieces, axis=0)
        contrast = np.sqrt((sums**2).sum(axis=-1)) / np.maximum(counts, 1)[:, None]
        best = contrast[:, 1:-1].argmax(axis=1) + 1
        before, at, after = (contrast[np.arange(len(best)), best + step] for step in (-1, 0, 1))
        bend = before - 2 * at + after
        is_peak = (bend < 0) & (at >= before) & (at >= after) & (counts >= 3)
        part = np.where(is_peak, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
        derivatives = np.add.reduceat(self._derivatives(heights) * inside[:, None], self._pieces, axis=0)
        derivatives /= np.maximum(counts, 1)[:, None]
        found = (steps[best] + part) * STEP_RAD
        crease = np.searchsorted(self.creases.starts, self._pieces, side="right")
        level = self.creases.level[self._pieces]
        return found[is_peak], at[is_peak], derivatives[is_peak], level[is_peak], crease[is_peak]

    def result(self, std: float) -> ScenePlane:
        """Return the plane at its place."""
        (x, z), offset = self._moved()
        uncertainty = std if self.plane.support else self.plane.uncertainty
        return replace(self.plane, normal=np.array([x, 0.0, z]), offset=offset, uncertainty=uncertainty)

    def _level_distances(self) -> FloatArray:
        normal, offset = self._moved()
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray((offset - self.creases.center[:, [0, 2]] @ normal) / (self._across @ normal))

    def _places(self, heights: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the place of the predicted creases in each profile, and whether it is inside."""
        distance = self._level_distances()
        dip = np.arctan2(heights[self.creases.level] - self.creases.center[:, 1], distance)
        place = (dip - self.creases.dip) / STEP_RAD + _REACH
        inside = (distance > 0) & (place >= 0) & (place < 2 * _REACH)
        return np.where(inside, place, 0.0), inside

    def _sampled(self, place: FloatArray, *, fine: bool) -> FloatArray:
        """Return the differences of colour at places (S, ...) of the profiles."""
        profiles = self.creases.fine if fine else self.creases.coarse
        samples = np.arange(len(place)).reshape(-1, *[1] * (place.ndim - 1))
        first = place.astype(np.int64)
        part = (place - first)[..., None]
        return np.asarray(profiles[samples, first] * (1 - part) + profiles[samples, first + 1] * part)

    def _derivatives(self, heights: FloatArray) -> FloatArray:
        normal, _ = self._moved()
        aside = np.array([-normal[1], normal[0]])
        distance, cosine = self._level_distances(), self._across @ normal
        down = heights[self.creases.level] - self.creases.center[:, 1]
        by_turn = (self._middle - self.creases.center[:, [0, 2]]) @ aside - distance * (self._across @ aside)
        by_distance = -down / (distance**2 + down**2)
        by_height = distance / (distance**2 + down**2)
        return np.stack([by_distance * self.distance / cosine, by_distance * by_turn / cosine, by_height], axis=-1)

    def _moved(self) -> tuple[FloatArray, float]:
        x, z = self.plane.normal[[0, 2]]
        sine, cosine = np.sin(self.turn), np.cos(self.turn)
        normal = np.array([x * cosine - z * sine, x * sine + z * cosine])
        return normal, float(self._middle @ normal + self.shift * self.distance)


def _tail(shift: FloatArray) -> FloatArray:
    """Return the Cauchy weights of shifts from the ranges, in standard deviations: these, too, can be wrong."""
    return np.asarray(1 / (1 + (shift / _TAIL) ** 2))


def _adjust(
    placed: dict[int, _Placement],
    heights: FloatArray,
    planes: Sequence[ScenePlane],
    *,
    level_distances: Sequence[float],
) -> dict[int, float]:
    """Move all planes together to where pieces of creases are (Gauss-Newton with Cauchy weights).

    `heights` of level planes are changed.

    Returns:
        Relative standard deviations of the distances of the planes.
    """
    levels = [idx for idx, plane in enumerate(planes) if plane.is_level]
    if not placed:
        return {}
    column = {idx: number for number, idx in enumerate(levels)}
    own = {idx: len(levels) + 2 * number for number, idx in enumerate(placed)}
    scales = np.array([level_distances[idx] for idx in levels])
    # Level planes are wide: in ranges of three rendered captures they were 0.02 to 0.8 % off. Cornices along all walls
    # would move them farther.
    stds = np.concatenate([[planes[idx].uncertainty / 3 for idx in levels], *(one.stds for one in placed.values())])
    start = np.array([heights[idx] for idx in levels])
    turns = np.array([at + 1 for at in own.values()])
    for scale in _SCALES_RAD:
        now = np.concatenate([(heights[levels] - start) / scales, *([one.shift, one.turn] for one in placed.values())])
        prior = _tail(now / stds) * stds**-2.0
        matrix, right = np.diag(prior), -prior * now
        for idx, placement in placed.items():
            residual, contrast, derivatives, level, crease = placement.measured(heights, 5 * scale)
            rows = np.zeros((len(residual), len(stds)))
            rows[:, own[idx] : own[idx] + 2] = derivatives[:, :2]
            which = np.array([column[one] for one in level], np.int64)
            rows[np.arange(len(rows)), which] = derivatives[:, 2] * scales[which]
            weight = np.minimum(contrast / CLEAR_LEVELS, 1.0) / _PIECE_RAD**2
            # Skirting boards, cornices and their shadows are edges off the planes. On nine runs of rendered
            # places, 0.005 of the level distance was compared with 0.003 and 0.01, and on four of them with 0.007.
            aside = derivatives[:, 0] / placement.distance
            edge = 0.005 * scales[which][:, None] * np.column_stack([derivatives[:, 2], aside])
            for one in np.unique(which):
                here = which == one
                square, product = _information(
                    rows[here], edge[here], residual[here], weight=weight[here], crease=crease[here], scale=scale
                )
                matrix += square
                right += product
        turned = _off_right_angles(np.array([one.azimuth for one in placed.values()]), stds[turns], 5 * scale)
        weight = 1 / ((5 * scale) ** 2 + turned**2)
        matrix[turns, turns] += weight
        right[turns] += weight * turned
        change = np.linalg.solve(matrix, right)
        heights[levels] += change[: len(levels)] * scales
        for idx, placement in placed.items():
            placement.shift += change[own[idx]]
            placement.turn += change[own[idx] + 1]
    found = np.sqrt(np.diag(np.linalg.inv(matrix)))
    # All ceilings of eight runs on rendered places were within six of these, but only 87 % within two.
    found[: len(levels)] *= 3
    return {idx: max(float(found[at]), LEAST_UNCERTAINTY) for idx, at in (column | own).items()}


def _off_right_angles(azimuths: FloatArray, stds: FloatArray, scale: float) -> FloatArray:
    """Return how far walls are turned from the nearest of four directions at right angles that most of them have."""
    weight, residual = stds**-2.0, np.zeros(len(azimuths))
    for _ in range(10):
        middle = np.angle(np.sum(weight / (scale**2 + residual**2) * np.exp(4j * azimuths))) / 4
        residual = np.angle(np.exp(4j * (azimuths - middle))) / 4
    return residual


def _information(
    rows: FloatArray,
    edge: FloatArray,
    residual: FloatArray,
    *,
    weight: FloatArray,
    crease: NDArray[np.int64],
    scale: float,
) -> tuple[FloatArray, FloatArray]:
    """Return what the pieces of all creases of two planes add to the normal equations: matrix and right side.

    All views see one edge, whose place relative to the planes is eliminated: `edge` (P, 2) are the changes of the dip
    when it moves by one standard deviation; this has tails, too. `crease` (P,): the crease of one view that a piece is
    on.
    """
    off, reliable = residual, weight
    inverse: NDArray[Any] = np.eye(2)
    place: NDArray[Any] = np.zeros(2)
    for _ in range(4):
        reliable = weight.copy()
        for one in np.unique(crease):
            here = crease == one
            reliable[here] *= _reliability(off[here], weight[here], scale)
        inverse = np.linalg.inv((edge * reliable[:, None]).T @ edge + np.diag(1 / (1 + place**2)))
        place = inverse @ (edge.T @ (reliable * residual))
        off = residual - edge @ place
    weighted = rows * reliable[:, None]
    shared = weighted.T @ edge
    return weighted.T @ rows - shared @ inverse @ shared.T, weighted.T @ residual - shared @ place


def _reliability(residual: FloatArray, weight: FloatArray, scale: float) -> FloatArray:
    """Return factors for the weights of the pieces of a crease in one view, which are off by angles.

    Pieces scatter, and have an error in common: views may see different edges. Both have tails (Cauchy).
    """
    order = np.argsort(residual)
    total = np.cumsum(weight[order])
    common = residual[order][np.searchsorted(total, total[-1] / 2)]
    alike = 1 / (1 + ((residual - common) / _PIECE_RAD) ** 2)
    variance = scale**2 + common**2
    return np.asarray(alike / (1 + (weight * alike).sum() * variance))


def _creases(
    views: Sequence[PlaneView], planes: Sequence[ScenePlane], tolerance: float, *, threads: int
) -> dict[int, _Creases]:
    """Return the creases of each upright plane that has any."""
    pairs = [
        (idx, level)
        for idx, upright in enumerate(planes)
        for level, other in enumerate(planes)
        if other.is_level and not upright.is_level
    ]

    def seen_in(view: PlaneView) -> list[tuple[int, tuple[FloatArray, ...]]]:
        labels, picture = _shown_planes(view, planes, tolerance), blurred(view.load())
        found: list[tuple[int, tuple[FloatArray, ...]]] = []
        for idx, level in pairs:
            sides = labels == idx, labels == level
            profiles = _profiles(view, planes[idx], planes[level].y, picture=picture, sides=sides)
            if profiles is not None:
                azimuth, dip, differences = profiles
                center = np.broadcast_to(view.cam_from_world.center, (len(azimuth), 3))
                found.append((idx, (azimuth, dip, center, np.full(len(azimuth), level), differences)))
        return found

    parts: dict[int, list[tuple[FloatArray, ...]]] = {}
    for of_view in mapped(seen_in, views, threads=threads):
        for idx, part in of_view:
            parts.setdefault(idx, []).append(part)
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
