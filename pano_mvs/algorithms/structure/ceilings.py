"""Place ceilings at the heights at which the creases of walls with floor and ceiling are clearest.

The elevation of a wall's crease with the floor gives its distance, and that of its crease with the ceiling then gives
the height of the ceiling, which all views and azimuths have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pano_mvs.algorithms.structure.outline import OUTLINE_UNCERTAINTY
from pano_mvs.algorithms.structure.skyline import (
    TURN_VIEWS,
    Skyline,
    clearest_total,
    clearest_turn,
    coarsely_around,
    possible_rooms,
    room_heights,
    wall_distances,
)
from pano_mvs.algorithms.structure.view import PlaneView, ScenePlane, plane_ranges
from pano_mvs.core.arrays import FloatArray

_FINE_DISTANCES = np.geomspace(0.35, 9.0, 220)
# Heights of a ceiling above the cameras that are tried, in heights of the camera above the floor.
_CEILINGS = np.geomspace(0.3, 1.6, 36)
# Heights relative to that of a ceiling in ranges, and to the best of these.
_MOVED_CEILINGS, _FINE_CEILINGS = np.linspace(0.9, 1.1, 11), np.linspace(0.98, 1.02, 9)
# Creases show its height if their mean clarity differs by this much between the heights: in plain boxes without visible
# creases it differed by at most 0.018, with and without noise, in rendered houses by 0.25 to 0.5, and in two groups of
# a real tour, over all heights, by 0.16 and 0.30.
_LEAST_SHOWN = 0.05
# Views show its height if this solid angle of their ranges is near it.
_LEAST_AREA = 0.2


def supposed_ceiling(views: Sequence[PlaneView], planes: Sequence[ScenePlane]) -> list[ScenePlane]:
    """Return a ceiling at the height at which creases of all views are clearest.

    None if they show no height, if a ceiling is known, or no floor is. A room and a lower, narrower one look much the
    same in one view, but not in several. `views`: those with sky above are ignored. `planes`: the level planes of the
    views.
    """
    lowest = max((view.cam_from_world.center[1] for view in views), default=0.0)
    floors = [plane for plane in planes if plane.normal[1] < 0 and plane.y > lowest]
    roofed = [view for view in views if _is_roofed(view)]
    if not floors or not roofed or any(possible_rooms(planes, view.cam_from_world.center) for view in views):
        return []
    floor = max(floors, key=lambda plane: plane.support)
    middle = float(np.mean([view.cam_from_world.center[1] for view in roofed]))
    y = middle - float(np.median(_CEILINGS)) * (floor.y - middle)
    plane = ScenePlane(-floor.normal, y, 0.0, uncertainty=OUTLINE_UNCERTAINTY, is_level=True)
    clarity = _HeightClarity.around(roofed, floor, plane)
    if clarity is None:
        return []
    shares = _CEILINGS / np.median(_CEILINGS)
    totals = [clarity.total(share) for share in shares]
    if np.ptp(totals) < _LEAST_SHOWN:
        return []
    share = shares[np.argmax(totals)]
    return [clarity.ceiling_at(clarity.clearest(share * _FINE_CEILINGS))]


def moved_ceilings(views: Sequence[PlaneView], planes: Sequence[ScenePlane]) -> list[ScenePlane]:
    """Return level planes, those with most support first; ceilings are at the heights at which creases are clearest.

    Ranges of a ceiling without texture can be wrong in all views by the same few percent; one whose ranges
    are certain stays. Ceilings at nearly one height are joined. `views`: of one group. `planes`: its level planes.
    """
    result: list[ScenePlane] = []
    for plane in sorted(planes, key=lambda plane: -plane.support):
        below = [view for view in views if plane.normal[1] > 0 and _area_on(view, plane) > _LEAST_AREA]
        if not below:
            result.append(plane)
            continue
        middle = float(np.mean([view.cam_from_world.center[1] for view in below]))
        floors = [other for other in planes if other.normal[1] < 0 and other.y > middle]
        # A plain ceiling of a rendered house was at 0.05, those of three captures, at most 1 % off, at 0.014 or less.
        is_plain = plane.uncertainty > 0.02
        if floors and is_plain and len(below) >= 3:
            # Of floors a little apart, views show nearly the same area.
            floor = max(floors, key=lambda other: other.support * sum(_area_on(view, other) for view in below))
            plane = _moved_ceiling(below, floor, plane)
        if not any(other.normal[1] > 0 and abs(other.y - plane.y) < 0.02 * (middle - plane.y)
                   for other in result):  # fmt: skip
            result.append(plane)
    return result


def _moved_ceiling(views: Sequence[PlaneView], floor: ScenePlane, ceiling: ScenePlane) -> ScenePlane:
    """Return a ceiling at the height at which creases of views with a floor are clearest, or as it is if none is."""
    clarity = _HeightClarity.around(views, floor, ceiling)
    if clarity is None:
        return ceiling
    totals = [clarity.total(share) for share in _MOVED_CEILINGS]
    best, shown = int(np.argmax(totals)), float(np.ptp(totals))
    if shown < _LEAST_SHOWN or best in (0, len(totals) - 1):
        return ceiling
    share = clarity.clearest(_MOVED_CEILINGS[best] * _FINE_CEILINGS)
    # At exact heights with clear creases, this share was below 0.002, and where heights were 1.4 % off, above 0.03.
    if clarity.total(share) - clarity.total(1.0) < 0.01 * shown:
        return ceiling
    # Moved ceilings were at most 1.3 % off in nine houses, but up to 3.5 % in boxes with faint creases.
    return replace(clarity.ceiling_at(share), uncertainty=max(ceiling.uncertainty, 0.02))


@dataclass(frozen=True, eq=False)
class _HeightClarity:
    """How clear the creases of views are with a floor, and with a ceiling at any height above the mean camera.

    `seen`: of each view, what it shows, the height of the ceiling above it, level distances of walls, and how clear
    their creases with the floor are.
    """

    ceiling: ScenePlane
    middle: float
    seen: Sequence[tuple[Skyline, float, FloatArray, FloatArray]]

    @staticmethod
    def around(views: Sequence[PlaneView], floor: ScenePlane, ceiling: ScenePlane) -> _HeightClarity | None:
        """Return what some of the views between a floor and a ceiling show; None if none is."""
        planes = [floor, ceiling]
        views = [view for view in views if possible_rooms(planes, view.cam_from_world.center)]
        if not views:
            return None
        middle = float(np.mean([view.cam_from_world.center[1] for view in views]))
        around = coarsely_around(views, planes, 12)
        turn = clearest_turn(around[:: -(-len(around) // TURN_VIEWS)], planes)
        seen = []
        for one in around:
            down, up = room_heights(one, planes, (0, 1))
            distance = wall_distances(one.sky, turn, down * _FINE_DISTANCES)
            seen.append((one.sky, up, distance, one.sky.crease_clarity(distance, -down)))
        return _HeightClarity(ceiling, middle, seen)

    def total(self, share: float) -> float:
        """Return the mean over views and azimuths with the ceiling at a share of its height; a view above it has none.

        Cameras differ in height: at a height that is below a camera, it counts with its creases with the floor.
        """
        more = (share - 1) * (self.middle - self.ceiling.y)
        means = []
        for sky, up, distance, on_floor in self.seen:
            on_ceiling = sky.crease_clarity(distance, up + more) if up + more > 0 else 0.0
            means.append(clearest_total(on_floor + on_ceiling) / distance.shape[1])
        return float(np.mean(means))

    def clearest(self, shares: FloatArray) -> float:
        """Return the share of the height of the ceiling at which creases are clearest."""
        return float(max(shares, key=self.total))

    def ceiling_at(self, share: float) -> ScenePlane:
        """Return the ceiling at a share of its height above the mean camera."""
        y = self.middle - share * (self.middle - self.ceiling.y)
        return replace(self.ceiling, offset=float(y * self.ceiling.normal[1]))


def _area_on(view: PlaneView, plane: ScenePlane) -> float:
    """Return the solid angle of a view whose ranges are near a plane."""
    ranges = plane_ranges(view.rays, view.cam_from_world.center, normal=plane.normal, offset=plane.offset)
    with np.errstate(invalid="ignore"):
        return float(view.area[np.abs(view.ranges / ranges - 1) < 0.1].sum())


def _is_roofed(view: PlaneView) -> bool:
    """Return whether most of the sphere around the zenith has a range."""
    above = view.rays[..., 1] < -0.7  # cosine of the angle to the zenith
    return bool(view.area[above & np.isfinite(view.ranges)].sum() > view.area[above].sum() / 2)
