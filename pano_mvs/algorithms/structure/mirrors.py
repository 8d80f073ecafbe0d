"""Mirrors on the upright planes of a place.

A surface looks alike from everywhere. What a mirror shows changes from view to view, and does so as the room in front
of it predicts: each view sees in the plane what a camera behind it would see of the room. So the colours of a grid on
the plane are compared with these predictions, both without their means over the views; a mirror is where they
correlate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.algorithms.structure.view import PlaneView, ScenePlane, plane_ranges
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.core.bands import mapped
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, MIRROR_CONFIDENCE, WEAK_CONFIDENCE
from pano_mvs.scene.surfaces import Structure

Image = NDArray[np.float32]

_VIEWS, _POINTS, _CELLS = 6, 250_000, 60_000
# Cells of the blur of colours and predictions, and of the window of the correlation.
_BLUR, _WINDOW = 2, 6
ON_PLANE, BEFORE_PLANE = 0.03, 0.07
# Of the cells of a mirror: the least correlation of each and of all; the area over the squared distance of the cameras;
# the share of the cells around it that lie on the plane; the explained contrast, in grey levels; and the share of views
# in which a cell is confirmed on the plane. Mirrors that were measured have .85–.94, .15–.35, .88–1, 13–15, .03–.26.
# Without a mirror, what meets the second to fourth condition explains 6 levels; what shines is confirmed in .6–1.
_LEAST_CORRELATION, _LEAST_MEAN, _LEAST_AREA, _LEAST_AROUND = 0.75, 0.8, 0.03, 0.8
_LEAST_LEVELS, _MOST_CONFIRMED = 10.0, 0.5
_GAINS = 0.1, 1.5
_NOISE_LEVELS = 3.0
_DOWN = np.array([0.0, 1.0, 0.0])


def find_mirrors(views: Sequence[PlaneView], planes: Sequence[ScenePlane], *, threads: int = 1) -> list[FloatArray]:
    """Return the corners (4, 3) in the world of the mirrors on upright planes, rectangles with level edges.

    `views`: of one group; at least two must see a mirror. `planes`: of the place.
    """
    seen = [PicturedView.of(view) for view in views]
    walls = [plane for plane in planes if not plane.is_level]
    found = [one for of_wall in mapped(lambda wall: _mirrors_on(wall, seen), walls, threads=threads) for one in of_wall]
    kept: list[FloatArray] = []
    for _, corners, center in sorted(found, key=lambda one: -one[0]):
        middle = corners.mean(axis=0) - center
        if not any(np.isfinite(pane_ranges(middle, center, other)) for other in kept):
            kept.append(corners)
    return kept


def pane_ranges(rays: FloatArray, center: FloatArray, corners: FloatArray) -> FloatArray:
    """Return the ranges along rays (..., 3) from a centre (3,) to the front of a rectangle (4, 3); NaN beside it."""
    along, down = corners[1] - corners[0], corners[3] - corners[0]
    normal = np.cross(down, along)
    normal /= np.linalg.norm(normal)
    ranges = plane_ranges(rays, center, normal=normal, offset=float(corners[0] @ normal))
    within = center + rays * ranges[..., None] - corners[0]
    shares = np.stack([within @ along / (along @ along), within @ down / (down @ down)])
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(((shares >= 0) & (shares <= 1)).all(axis=0), ranges, np.nan))


def with_mirrors(
    range_map: RangeMap,
    structure: Structure,
    cam_from_world: Rigid3,
    *,
    group: int = 0,
    valid: Mask | None = None,
    laid: Mask | None = None,
) -> RangeMap:
    """Give what a view sees in mirrors the range of the pane, and `MIRROR_CONFIDENCE`.

    Pixels with a range before the pane that was seen, or is on a plane, keep it, and the sky has none.

    Args:
        range_map: (H, W), the full sphere.
        structure: mirrors in the world.
        cam_from_world: pose of the view.
        group: of the poses of the view.
        valid: (H, W) pixels that may have a range; None: all.
        laid: (H, W) pixels whose range is on a plane of the place; None: none is known to be.
    """
    corners = structure.mirror_corners[structure.mirror_group_idx == group]
    if not len(corners):
        return range_map
    rays = ray_grid(range_map.range.shape) @ cam_from_world.rotation
    pane = np.fmin.reduce([pane_ranges(rays, cam_from_world.center, one) for one in corners])
    known = (range_map.confidence >= WEAK_CONFIDENCE[0]) | (False if laid is None else laid)
    shown = np.isfinite(pane) & ~(known & (range_map.range < pane * (1 - BEFORE_PLANE)))
    for ignored in (None if valid is None else ~valid, range_map.sky):
        shown = shown if ignored is None else shown & ~ignored
    uncertainty, normals = range_map.uncertainty, range_map.normals_in_cam
    return replace(
        range_map,
        range=np.where(shown, pane, range_map.range).astype(np.float32),
        confidence=np.where(shown, np.uint8(MIRROR_CONFIDENCE), range_map.confidence),
        uncertainty=None if uncertainty is None else np.where(shown, np.float16(np.nan), uncertainty),
        normals_in_cam=None if normals is None else np.where(shown[..., None], np.float16(np.nan), normals),
    )


@dataclass(frozen=True, eq=False)
class PicturedView:
    """A view with its picture (h, w, 3) at the size of the grid."""

    view: PlaneView
    picture: Picture

    @classmethod
    def of(cls, view: PlaneView) -> PicturedView:
        """Load the picture of a view."""
        return cls(view, cv2.resize(view.load(), view.ranges.shape[::-1], interpolation=cv2.INTER_AREA))

    @property
    def center(self) -> FloatArray:
        """The position of the camera, (3,)."""
        return self.view.cam_from_world.center

    def on(self, plane: ScenePlane) -> FloatArray:
        """Return the points (N, 3) on a plane, of every fourth row and column."""
        some = slice(None, None, 4), slice(None, None, 4)
        rays, own = self.view.rays[some], self.view.ranges[some]
        ranges = plane_ranges(rays, self.center, normal=plane.normal, offset=plane.offset)
        with np.errstate(invalid="ignore"):
            near = (np.abs(own / ranges - 1) < ON_PLANE) & (self.view.confidence[some] >= WEAK_CONFIDENCE[0])
        return np.asarray(self.center + rays[near] * ranges[near][:, None])

    def before(self, plane: ScenePlane, *, height: float, most: int) -> tuple[FloatArray, Image]:
        """Return points (N, 3) at more than a height before a plane, evenly and at most `most`, and their colours."""
        points = self.center + self.view.rays * self.view.ranges[..., None]
        with np.errstate(invalid="ignore"):
            chosen = np.flatnonzero(points @ plane.normal - plane.offset > height)
        chosen = chosen[:: -(-len(chosen) // most)] if len(chosen) else chosen
        return points.reshape(-1, 3)[chosen], self.picture.reshape(-1, 3)[chosen].astype(np.float32)

    def colors_at(self, points: FloatArray) -> tuple[Image, FloatArray, NDArray[np.uint8]]:
        """Return colours, ranges over distances, and confidences where the view sees points (h, w, 3)."""
        in_cam = self.view.cam_from_world.apply(points)
        distance = np.linalg.norm(in_cam, axis=-1)
        pixels = pixel_from_ray(in_cam, self.view.ranges.shape).astype(np.float32) - 0.5
        padded = np.concatenate([self.picture, self.picture[:, :1]], axis=1).astype(np.float32)
        columns = np.mod(pixels[..., 0], self.picture.shape[1])
        colors = cv2.remap(padded, columns, pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        row, column = pixels_containing(in_cam, self.view.ranges.shape)
        return np.asarray(colors), self.view.ranges[row, column] / distance, self.view.confidence[row, column]


@dataclass(frozen=True, eq=False)
class Grid:
    """Square cells of a rectangle of an upright plane: `low` (2,) are the level and the y coordinate of its corner."""

    plane: ScenePlane
    low: FloatArray
    cell: float
    size_hw: tuple[int, int]

    @property
    def along(self) -> FloatArray:
        """The direction of the rows, (3,)."""
        return np.cross(self.plane.normal, _DOWN)

    def at(self, column: FloatArray, row: FloatArray) -> FloatArray:
        """Return the points (..., 3) at positions in cells."""
        level, down = (self.low[0] + column * self.cell)[..., None], (self.low[1] + row * self.cell)[..., None]
        return np.asarray(self.plane.normal * self.plane.offset + level * self.along + down * _DOWN)

    def centers(self) -> FloatArray:
        """Return the centres (h, w, 3) of the cells."""
        row, column = np.indices(self.size_hw) + 0.5
        return self.at(column, row)

    def cells_of(self, points: FloatArray) -> NDArray[np.int64]:
        """Return the column and row (N, 2) of points on the plane, also outside."""
        level = np.stack([points @ self.along, points[:, 1]], axis=-1)
        return np.floor((level - self.low) / self.cell).astype(np.int64)


def _mirrors_on(plane: ScenePlane, seen: Sequence[PicturedView]) -> list[tuple[float, FloatArray, FloatArray]]:
    """Return the strength and the corners of each mirror on a plane, and the centre of a camera before it."""
    shares = [one.on(plane) for one in seen]
    least = 0.005 * seen[0].view.ranges.size / 16
    chosen = [
        idx
        for idx in np.argsort([-len(points) for points in shares], kind="stable")[:_VIEWS]
        if len(shares[idx]) > least
    ]
    if len(chosen) < 2:
        return []
    used = [seen[idx] for idx in chosen]
    distance = float(np.median([one.center @ plane.normal - plane.offset for one in used]))
    grid = grid_of(plane, [shares[idx] for idx in chosen], distance / seen[0].view.ranges.shape[0])
    parts = [one.before(plane, height=0.05 * distance, most=_POINTS // len(used)) for one in used]
    points, colors = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    pictures, predicted, weights, on_plane = [], [], [], np.zeros(grid.size_hw, np.bool_)
    confirmed = np.zeros(grid.size_hw)
    for one in used:
        picture, ratio, confidence = one.colors_at(grid.centers())
        reflected, known = _reflected(one.center, grid, points=points, colors=colors)
        with np.errstate(invalid="ignore"):
            known &= ~(ratio < 1 - BEFORE_PLANE)
            near = known & (np.abs(ratio - 1) < ON_PLANE)
        on_plane |= near & (confidence >= WEAK_CONFIDENCE[0])
        confirmed += near & (confidence >= CONSISTENT_CONFIDENCE[0])
        weights.append(known.astype(np.float32))
        pictures.append(picture)
        predicted.append(reflected)
    sums = _sums(*(np.array(arrays) for arrays in (pictures, predicted, weights)))
    label = sums.areas()
    found = []
    for number in range(1, label.max() + 1):
        mirror = cv2.morphologyEx(
            (label == number).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((2 * _WINDOW + 1,) * 2, np.uint8)
        )
        inside = mirror > 0
        mean = sums.correlation(inside)
        area = inside.sum() * (grid.cell / distance) ** 2
        near, far = (cv2.dilate(mirror, np.ones((size,) * 2, np.uint8)) for size in (2 * _WINDOW - 1, 4 * _WINDOW + 1))
        around = on_plane[far > near]
        is_surface = confirmed[inside].sum() > _MOST_CONFIRMED * np.sum(weights, axis=0)[inside].sum()
        is_clear = mean >= _LEAST_MEAN and sums.explained(inside) >= _LEAST_LEVELS
        if area >= _LEAST_AREA and is_clear and not is_surface and around.size and around.mean() >= _LEAST_AROUND:
            left, right, top, bottom = _outlined(inside, np.mean(pictures, axis=0))
            # Mirrors are rectangles. Of those that were measured, all but a hundredth of the area lay in this one and
            # filled .46 to .81 of it; of an area on a wall without a mirror, .43 lay in it.
            common = int(inside[top:bottom, left:right].sum())
            if common > 0.8 * inside.sum() and 3 * common > (right - left) * (bottom - top):
                columns, rows = np.array([left, right, right, left], np.float64), np.array([top, top, bottom, bottom])
                found.append((mean * float(area), grid.at(columns, rows), used[0].center))
    return found


def grid_of(plane: ScenePlane, on_plane: Sequence[FloatArray], pixel: float) -> Grid:
    """Return cells over the points (N, 3) that views have on a plane, about as wide as a pixel."""
    axes = np.stack([np.cross(plane.normal, _DOWN), _DOWN], axis=1)
    limits = [np.percentile(points @ axes, (1, 99), axis=0) for points in on_plane]
    low, high = np.min([one[0] for one in limits], axis=0), np.max([one[1] for one in limits], axis=0)
    cell = max(2.0 * pixel, float(np.sqrt(np.prod(high - low) / _CELLS)))
    width, height = np.maximum(np.ceil((high - low) / cell), 1).astype(int)
    return Grid(plane, low, cell, (int(height), int(width)))


def _reflected(center: FloatArray, grid: Grid, *, points: FloatArray, colors: Image) -> tuple[Image, Mask]:
    """Return what a mirror would show a camera in each cell, (h, w, 3), and where that is known.

    `points`: (N, 3) before the plane, with `colors` (N, 3).
    """
    plane = grid.plane
    own, height = center @ plane.normal - plane.offset, points @ plane.normal - plane.offset
    behind = center - 2 * own * plane.normal
    ways = points - behind
    column, row = grid.cells_of(behind + ways * (own / (own + height))[:, None]).T
    inside = (column >= 0) & (row >= 0) & (column < grid.size_hw[1]) & (row < grid.size_hw[0])
    cells, depth = (row * grid.size_hw[1] + column)[inside], np.linalg.norm(ways[inside], axis=1).astype(np.float32)
    nearest = np.full(grid.size_hw, 1e30, np.float32)
    np.minimum.at(nearest.ravel(), cells, depth)
    # Points behind the nearest ones of the cells around them are hidden.
    front = depth < 1.08 * cv2.erode(nearest, np.ones((3, 3), np.uint8)).ravel()[cells]
    sums = [
        np.bincount(cells[front], values, minlength=nearest.size).reshape(grid.size_hw).astype(np.float32)
        for values in (np.ones(int(front.sum())), *colors[inside][front].T)
    ]
    weight = cv2.GaussianBlur(np.minimum(sums[0], 1.0), (0, 0), 1.0)
    means = np.stack(sums[1:], axis=-1) / np.maximum(sums[0], 1.0)[..., None]
    spread = cv2.GaussianBlur(means, (0, 0), 1.0) / np.maximum(weight, 1e-6)[..., None]
    return np.where((sums[0] > 0)[..., None], means, spread), (sums[0] > 0) | (weight > 0.05)


def _blurred(picture: Image, weight: Image) -> Image:
    total = cv2.GaussianBlur(weight, (0, 0), _BLUR)
    return np.asarray(cv2.GaussianBlur(picture * weight[..., None], (0, 0), _BLUR) / np.maximum(total, 1e-6)[..., None])


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over views and windows of a grid, (h, w) each.

    `products`: of colours and predictions, both without their means. `shown`, `predicted`: of the squares of each.
    `count`: of the weights.
    """

    products: Image
    shown: Image
    predicted: Image
    count: Image

    def correlation(self, cells: Mask) -> float:
        """Return the correlation over some cells."""
        products, *squares = (one[cells].sum() for one in (self.products, self.shown, self.predicted))
        return float(products / np.sqrt(squares[0] * squares[1]))

    def explained(self, cells: Mask) -> float:
        """Return the standard deviation of colours, in grey levels, that the prediction explains in some cells."""
        products, squares, count = (one[cells].sum() for one in (self.products, self.predicted, self.count))
        return float(products / np.sqrt(3 * squares * count))

    def areas(self) -> NDArray[np.int32]:
        """Return the number (h, w) of the area that may be a mirror, 0 elsewhere."""
        gain = self.products / np.maximum(self.predicted, 1e-6)
        alike = self.products > _LEAST_CORRELATION * np.sqrt(self.shown * self.predicted)
        # The noise of a prediction must not be all that there is of it.
        alike &= (self.count > 1.2) & (self.predicted > 3 * _NOISE_LEVELS**2 * self.count)
        alike &= (gain > _GAINS[0]) & (gain < _GAINS[1])
        return np.asarray(cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)[1])


def _sums(shown: Image, predicted: Image, weights: Image) -> _Sums:
    """Return the sums over views of colours and predictions (K, h, w, 3) with weights (K, h, w)."""
    count = weights.sum(axis=0)
    total = np.maximum(count, 1e-6)[..., None]
    shown, predicted = (
        np.array([_blurred(picture, weight) for picture, weight in zip(one, weights, strict=True)])
        for one in (shown, predicted)
    )
    weights = weights * (count > 1)

    def window(values: Image) -> Image:
        return np.asarray(cv2.GaussianBlur((values * weights).sum(axis=0).astype(np.float32), (0, 0), _WINDOW))

    own, other = (one - (one * weights[..., None]).sum(axis=0) / total for one in (shown, predicted))
    # Exposures differ between views.
    share = weights / np.maximum(weights.sum(axis=(1, 2), keepdims=True), 1e-6)
    own, other = (one - np.einsum("khwc,khw->kc", one, share)[:, None, None] for one in (own, other))
    products = (np.einsum("khwc,khwc->khw", *pair) for pair in ((own, other), (own, own), (other, other)))
    both, own_squares, other_squares = (window(one) for one in products)
    weight = window(np.ones_like(weights))
    return _Sums(both, own_squares + 3 * _NOISE_LEVELS**2 * weight, other_squares, weight)


def _outlined(inside: Mask, steady: Image) -> tuple[int, int, int, int]:
    """Return the ends of the columns and rows of a mirror, at edges of the mean picture near the ends of its cells."""
    sides: list[int] = []
    for axis in (1, 0):
        filled = inside.sum(axis=1 - axis)
        full = np.flatnonzero(filled > 0.4 * filled.max())
        changes = np.abs(np.diff(steady, axis=axis)).sum(axis=-1)
        change = changes.compress(inside.any(axis=axis), axis=1 - axis).mean(axis=1 - axis)
        for end in (full[0], full[-1] + 1):
            near = np.arange(max(1, end - 2 * _WINDOW), min(len(change), end + 2 * _WINDOW) + 1)
            sides.append(int(near[np.argmax(change[near - 1])]) if len(near) else int(end))
    left, right, top, bottom = sides
    return left, right, top, bottom
