"""Windows that a view shows in the walls of a place: bright rectangles with sharp edges.

What lies behind a pane is lit by the sky, and a surface in the room sends back no more light than it gets. So a window
is brighter than nearly all that is known to be a surface, and than the wall just beside it on all sides: lamps make
walls bright without an edge. What is confirmed on the wall, such as a poster, is a surface.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.algorithms.structure.mirrors import BEFORE_PLANE, ON_PLANE, PicturedView, grid_of, pane_ranges
from pano_mvs.algorithms.structure.view import PlaneView, ScenePlane, plane_ranges
from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

_LEVELS = np.geomspace(0.6, 3.0, 10)  # of light, relative to the median on the wall, which may be that of a window
# Of a window: the solid angle; the share of its rectangle that is bright; the logarithm of its light relative to what
# is beside it, on the worst of at least three sides; the share of the surfaces that are darker; the share of the cells
# around it that show the wall, and of its own that are confirmed on it. The 25 windows that were measured in two houses
# have .26–.93, .95–1, .32–1 and 0–.55 of the last four. In these, a classroom and a hall, white radiators and cabinets
# have .5–.92 of the second of these, and the light of lamps on walls has less than .1 of the first.
_LEAST_AREA, _LEAST_FILL, _LEAST_STEP, _LEAST_RANK, _LEAST_AROUND, _MOST_CONFIRMED = 0.02, 0.7, 0.2, 0.95, 0.3, 0.5
_BARS, _EDGE, _GAP = 5, 3, 1  # cells of bars between panes, of each side of an edge, and between these

Rows = tuple[slice, slice]


def window_labels(view: PlaneView, label: NDArray[np.int16], planes: Sequence[ScenePlane]) -> NDArray[np.int16]:
    """Return the position in `planes` of the wall in which each pixel shows a window, (h, w), −1 for none.

    `label`: (h, w) the same of the plane that each pixel shows. `planes`: of the place.
    """
    seen, found, pixel = PicturedView.of(view), np.full(label.shape, -1, np.int16), np.pi / len(label)
    brightness = _light(seen.picture)
    for number, plane in enumerate(planes):
        shown = label == number
        ranges = plane_ranges(view.rays[shown], seen.center, normal=plane.normal, offset=plane.offset)
        on_wall = np.isfinite(ranges)
        if plane.is_level or on_wall.sum() * pixel**2 < _LEAST_AREA:
            continue
        points = seen.center + view.rays[shown][on_wall] * ranges[on_wall, None]
        away = float(np.median(ranges[on_wall]))
        grid = grid_of(plane, [points], away * pixel / 2)
        colors, ratio, confidence = seen.colors_at(grid.centers())
        wall = shown[pixels_containing(view.cam_from_world.apply(grid.centers()), label.shape)]
        light, confirmed = _light(colors), confidence >= CONSISTENT_CONFIDENCE[0]
        with np.errstate(invalid="ignore"):
            hidden = confirmed & (ratio < 1 - BEFORE_PLANE)
            on_it = confirmed & (np.abs(ratio - 1) < ON_PLANE)
        usual = np.median(light[wall]) if wall.any() else np.nan
        for box in _bright_boxes(light / usual, ~hidden, least=_LEAST_AREA * (away / grid.cell) ** 2):
            (top, bottom), (left, right) = ((float(one.start), float(one.stop)) for one in box)
            corners = grid.at(np.array([left, right, right, left]), np.array([top, top, bottom, bottom]))
            inside = np.isfinite(pane_ranges(view.rays, seen.center, corners))
            around = np.zeros(light.shape, np.bool_)
            around[_grown(box, _GAP + _EDGE)] = True
            around[_grown(box, _GAP)] = False
            surfaces = (label >= 0) & ~inside
            darker = surfaces & (brightness < np.median(light[box]))
            is_bright = darker.sum() > _LEAST_RANK * surfaces.sum()
            is_in_wall = wall[around].sum() > _LEAST_AROUND * around.sum()
            if is_bright and is_in_wall and on_it[box].mean() < _MOST_CONFIRMED:
                found[inside] = number
    return found


def _light(colors: NDArray[np.generic]) -> FloatArray:
    """Return the light (...) of colours (..., 3) with the usual gamma, never 0."""
    return np.asarray((np.maximum(colors.mean(axis=-1), 2.0) / 255) ** 2.2)


def _bright_boxes(light: FloatArray, seen: Mask, *, least: float) -> Iterator[Rows]:
    """Yield rectangles that are brighter than what is beside them; some overlap.

    `light`: (h, w) relative to the wall. `seen`: (h, w) where nothing is before it. `least`: number of bright cells.
    """
    for level in _LEVELS:
        bright = np.pad(((light > level) & seen).astype(np.uint8), _BARS)
        bright = cv2.morphologyEx(bright, cv2.MORPH_CLOSE, np.ones((_BARS, _BARS), np.uint8))
        closed = bright[_BARS:-_BARS, _BARS:-_BARS]
        for left, top, width, height, area in cv2.connectedComponentsWithStats(closed, connectivity=4)[2][1:]:
            box = slice(top, top + height), slice(left, left + width)
            if area >= max(least, _LEAST_FILL * width * height) and min(width, height) >= _BARS:
                steps = [_step(light, seen, edge) for edge in _edges(box)]
                known = [step for step in steps if not np.isnan(step)]
                if len(known) >= 3 and min(known) > _LEAST_STEP:
                    yield box


def _step(light: FloatArray, seen: Mask, edge: tuple[Rows, Rows]) -> float:
    """Return the logarithm of the light inside an edge relative to that outside; NaN if little is seen of that."""
    inner, outer = edge
    known = seen[outer]
    if known.sum() <= 0.3 * known.size:
        return float("nan")
    return float(np.log(np.median(light[inner]) / np.median(light[outer][known])))


def _edges(box: Rows) -> Iterator[tuple[Rows, Rows]]:
    """Yield the cells on the inner and on the outer side of each edge of a box."""
    for axis, one in enumerate(box):
        for inner, outer in (
            ((one.start, one.start + _EDGE), (one.start - _GAP - _EDGE, one.start - _GAP)),
            ((one.stop - _EDGE, one.stop), (one.stop + _GAP, one.stop + _GAP + _EDGE)),
        ):
            first, last = (slice(max(low, 0), max(high, 0)) for low, high in (inner, outer))
            yield ((first, box[1]), (last, box[1])) if axis == 0 else ((box[0], first), (box[0], last))


def _grown(box: Rows, cells: int) -> Rows:
    rows, columns = (slice(max(one.start - cells, 0), one.stop + cells) for one in box)
    return rows, columns
