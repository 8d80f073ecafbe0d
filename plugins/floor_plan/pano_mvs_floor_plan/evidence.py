"""What the views of one storey show of it, in layers of a grid seen from above: surfaces, and what they see through."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.uncertainty import UNCONFIRMED_UNCERTAINTY
from pano_mvs.algorithms.fusion.view import normals_from_range
from pano_mvs.algorithms.points.plan_grid import Extent, Storey
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.algorithms.structure.view import grid_rows, on_grid
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE, WINDOW_CONFIDENCE

_CLOUD_SIZE = 90, 180
_TURNS = 720

SURE = UNCONFIRMED_UNCERTAINTY / 3
"""Relative standard deviation up to which ranges count that no view confirms."""

LAYERS = 16
"""Number of layers between floor and ceiling."""

TOP = slice(LAYERS - 2, LAYERS)
"""The layers above doors and windows, in which rooms are told apart."""


@dataclass(frozen=True, eq=False)
class PlanView:
    """The ranges of a view with z up.

    `center`: (3,). `cam_from_plan`: (3, 3). `free`: (h, w) ranges up to which nothing is in the way, NaN where unknown.
    `seen`: (h, w) ranges that were seen, not filled, or of panes, infinite in the sky, NaN elsewhere. `errors`: (h, w)
    their relative standard deviations. `panes`: (h, w) whether they are those of windows. `points`: (N, 3) places on
    surfaces. `normals`: (N, 3) of the surfaces, NaN where unknown. `point_errors`: (N,) relative standard deviations of
    the ranges of the places, NaN where unknown.
    """

    center: FloatArray
    cam_from_plan: FloatArray
    free: FloatArray
    seen: FloatArray
    errors: FloatArray
    panes: NDArray[np.bool_]
    points: FloatArray
    normals: FloatArray
    point_errors: FloatArray

    def pixels_of(self, places: FloatArray) -> tuple[FloatArray, tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Return the distances of places (..., 3), and the rows and columns where they are seen, (...,) each."""
        way = places - self.center
        return np.linalg.norm(way, axis=-1), pixels_containing(way @ self.cam_from_plan.T, self.free.shape)

    def box(self) -> tuple[FloatArray, FloatArray]:
        """Return the lower and the upper corner (2,) of what it sees, except what is far from the rest."""
        low, high = np.quantile(self.points[:, :2], [0.005, 0.995], axis=0)
        return low, high


def range_view(range_map: RangeMap, cam_from_plan: Rigid3) -> PlanView:
    """Return the view of a range map, on about 256 rows; ranges that nothing confirms count as unknown."""
    height, width = range_map.range.shape
    rows = grid_rows(height)
    given = None if range_map.normals_in_cam is None else range_map.normals_in_cam.astype(np.float32)
    every, confidence = on_grid(range_map.range, rows).astype(np.float64), on_grid(range_map.confidence, rows)
    error = np.where(confidence >= CONSISTENT_CONFIDENCE[0], 0.0, UNCONFIRMED_UNCERTAINTY)
    if range_map.uncertainty is not None:
        given_error = on_grid(range_map.uncertainty, rows).astype(np.float64)
        error = np.where(np.isnan(given_error), UNCONFIRMED_UNCERTAINTY, given_error)
    panes = confidence == WINDOW_CONFIDENCE
    # Confirmed neither by views nor by planes.
    uncertain = (error > SURE) & (confidence < CONSISTENT_CONFIDENCE[0])
    ranges = np.where(uncertain | panes, np.nan, every)
    normals = on_grid(normals_from_range(range_map, given=given), rows)
    known = np.isfinite(ranges)
    rays = on_grid(ray_grid((height, width)), rows)
    sky = np.zeros_like(known) if range_map.sky is None else on_grid(range_map.sky, rows)
    seen = np.where((confidence < WEAK_CONFIDENCE[0]) & ~panes, np.nan, every)
    return PlanView(
        cam_from_plan.center,
        cam_from_plan.rotation,
        ranges * (1 - 2 * error),
        np.where(sky, np.inf, seen),
        np.where(sky, 0.0, error),
        panes,
        cam_from_plan.inverse().apply(rays[known] * ranges[known][:, None]),
        normals[known] @ cam_from_plan.rotation,
        error[known] if range_map.uncertainty is not None else np.full(int(known.sum()), np.nan),
    )


class CloudViews:
    """The views of a cloud whose range maps are not known: each point is seen from the nearest camera before it."""

    def __init__(self, cams_from_plan: Sequence[Rigid3]) -> None:
        self._cams = cams_from_plan
        self._tree = scipy.spatial.cKDTree([cam.center for cam in cams_from_plan])
        # x, y, z, their normal's and the range of the nearest point in each pixel
        self._seen = np.full((len(cams_from_plan), *_CLOUD_SIZE, 7), np.inf, np.float32)

    def add(self, points: FloatArray, normals: FloatArray) -> None:
        """Add points (N, 3) with z up, and their unit normals (N, 3)."""
        near = np.asarray(self._tree.query(points, k=np.arange(1, 1 + min(4, len(self._cams))))[1])
        way = self._tree.data[near] - points[:, None]
        before = (way * normals[:, None]).sum(axis=-1) > 0
        camera = np.where(before.any(axis=1), near[np.arange(len(near)), before.argmax(axis=1)], -1)
        for number in np.unique(camera[camera >= 0]):
            own = camera == number
            in_cam = self._cams[number].apply(points[own])
            distance = np.linalg.norm(in_cam, axis=1)
            far_first = np.argsort(-distance, kind="stable")
            row, column = (index[far_first] for index in pixels_containing(in_cam, _CLOUD_SIZE))
            found = np.column_stack([points[own], normals[own], distance])[far_first]
            nearer = found[:, 6] < self._seen[number, row, column, 6]
            self._seen[number, row[nearer], column[nearer]] = found[nearer]

    def view(self, number: int) -> PlanView:
        """Return the view of a camera."""
        seen = self._seen[number].astype(np.float64)
        ranges = np.where(np.isinf(seen[..., 6]), np.nan, seen[..., 6])
        known = seen[np.isfinite(ranges)]
        cam, exact = self._cams[number], np.zeros_like(ranges)
        panes = np.zeros(ranges.shape, np.bool_)
        places, normals, unknown = known[:, :3], known[:, 3:6], np.full(len(known), np.nan)
        return PlanView(cam.center, cam.rotation, ranges, ranges, exact, panes, places, normals, unknown)


@dataclass(frozen=True, eq=False)
class WallCells:
    """Cells of a plan with vertical surfaces.

    `xy`: (N, 2) mean position of the points in each cell. `normals_xy`: (N, 2) unit normals, on the side that was seen.
    `layers`: (N, LAYERS) whether such points are in a layer. `cell`: edge of a cell.
    """

    xy: FloatArray
    normals_xy: FloatArray
    layers: NDArray[np.bool_]
    cell: float

    def only(self, chosen: NDArray[np.bool_]) -> WallCells:
        """Return some of the cells."""
        return WallCells(self.xy[chosen], self.normals_xy[chosen], self.layers[chosen], self.cell)


class Evidence:
    """How many views see a vertical surface in each cell of each layer, and how many see through the top layers."""

    def __init__(self, storey: Storey, extent: Extent) -> None:
        self.storey, self.extent = storey, extent
        count = extent.size_hw[0] * extent.size_hw[1]
        self.free, self.hits = np.zeros(count, np.int32), np.zeros((count, LAYERS), np.uint16)
        self._sums = np.zeros((count, 5))  # x, y, their normal's, number

    def add(self, view: PlanView) -> None:
        """Add a view."""
        if not len(view.points):
            return
        index, inside = self.extent.cells(view.points[:, :2])
        layer = np.floor((view.points[:, 2] - self.storey.floor) / self._layer).astype(np.int64)
        with np.errstate(invalid="ignore"):
            inside &= (layer >= 0) & (layer < LAYERS) & (np.abs(view.normals[:, 2]) < 0.35)
        chosen = index[inside]
        self.hits.reshape(-1)[np.unique(chosen * LAYERS + layer[inside])] += 1
        values = np.column_stack([view.points[inside, :2], view.normals[inside, :2], np.ones(len(chosen))])
        for column in range(5):
            self._sums[:, column] += np.bincount(chosen, values[:, column], len(self._sums))
        self._add_free(view, None)

    def recount(self, views: Iterable[PlanView]) -> None:
        """Count again what the views see through, but not beyond walls that more of them see than see through."""
        walls = np.flatnonzero(self.hits[:, TOP].sum(axis=1) >= np.maximum(self.free, 1))
        self.free[:] = 0
        for view in views:
            self._add_free(view, walls)

    def _add_free(self, view: PlanView, walls: NDArray[np.intp] | None) -> None:
        """Count the cells of top layers that a view sees through, before walls."""
        if not len(view.points):
            return
        centers, (low, high) = self.extent.centers(), view.box()
        near = np.flatnonzero(((centers >= low) & (centers <= high)).all(axis=1))
        if walls is not None:
            until, (turn, away) = np.full(_TURNS, np.inf), _polar(centers[walls] - view.center[:2])
            np.minimum.at(until, turn, away)
            until = np.min([np.roll(until, step) for step in (-1, 0, 1)], axis=0)  # gaps between near cells
            turn, away = _polar(centers[near] - view.center[:2])
            near = near[away < until[turn]]
        for top in range(LAYERS)[TOP]:
            height = self.storey.floor + (top + 0.5) * self._layer
            away, pixels = view.pixels_of(np.column_stack([centers[near], np.full(len(near), height)]))
            with np.errstate(invalid="ignore"):
                self.free[near[view.free[pixels] - away > 1.5 * self.extent.pixel]] += 1

    @property
    def _layer(self) -> float:
        return max(self.storey.height, 1e-12) / LAYERS

    def wall_cells(self) -> WallCells:
        """Return the cells with vertical surfaces."""
        lengths = np.linalg.norm(self._sums[:, 2:4], axis=1)
        used = np.flatnonzero(lengths > 0.3 * self._sums[:, 4])  # points whose normals agree
        sums, lengths = self._sums[used], lengths[used]
        return WallCells(
            sums[:, :2] / sums[:, 4:], sums[:, 2:4] / lengths[:, None], self.hits[used] > 0, self.extent.pixel
        )


def _polar(way: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the directions of ways (N, 2), in parts of a turn, and their lengths."""
    turn = np.arctan2(way[:, 1], way[:, 0]) / (2 * np.pi)
    return np.floor(turn * _TURNS).astype(np.int64) % _TURNS, np.hypot(way[:, 0], way[:, 1])
