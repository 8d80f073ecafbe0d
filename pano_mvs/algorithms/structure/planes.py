"""Find the level and upright planes of a place in the range maps of all views, with y down along gravity.

Planes are drawn from single points (level planes) or pairs of points of one view (upright planes), the one that most of
the remaining points support is kept, and its points are removed (sequential RANSAC). Then the lines where upright
planes meet level ones place them: see `creases`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.structure.ceilings import moved_ceilings, supposed_ceiling
from pano_mvs.algorithms.structure.creases import placed_by_creases
from pano_mvs.algorithms.structure.mirrors import find_mirrors
from pano_mvs.algorithms.structure.outline import outline_planes
from pano_mvs.algorithms.structure.view import LEAST_UNCERTAINTY, PlaneView, ScenePlane, plane_view
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import UP
from pano_mvs.scene import Poses, RangeMap
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.range_map import WEAK_CONFIDENCE
from pano_mvs.scene.surfaces import Structure

_FIT_ROUNDS = 5
_ALONG_NORMAL = 0.7
# Cosines of the angles between the two points that a plane is drawn from.
_PAIR_COSINES = 0.9, 0.9985


def find_planes(
    views: Sequence[PlaneView],
    *,
    rng: np.random.Generator,
    max_relative_error: float,
    min_share: float,
    threads: int = 1,
) -> list[ScenePlane]:
    """Return the planes of one group of views, whose world has y down along gravity; level planes first.

    `views`: of one group. `rng`: draws points and planes. `max_relative_error`: of the ranges of points on a plane.
    `min_share`: least support of a plane, in spheres: 1 if it filled one view. `threads`: number of threads.
    """
    points = _drawn_points(views, rng)
    if points is None:
        return []
    least = min_share * 4 * np.pi
    planes = [
        plane
        for normal in (UP, -UP)
        for plane in _level_planes(points, normal, rng=rng, tolerance=max_relative_error, least=least)
    ]
    planes = moved_ceilings(views, planes)
    planes += supposed_ceiling(views, planes)
    planes += _upright_planes(points, rng=rng, tolerance=max_relative_error, least=least)
    planes += outline_planes(views, planes, threads=threads)
    return placed_by_creases(views, planes, max_relative_error=max_relative_error, threads=threads)


def find_floors(views: Sequence[PlaneView], *, rng: np.random.Generator) -> list[ScenePlane]:
    """Return the level planes below the views of one group, whose world has y down, that bound what they see.

    More of what views see is on such a plane than beyond it: a table top does not bound, the floor around it does.
    """
    points = _drawn_points(views, rng)
    if points is None:
        return []
    # Half of the error within which two small sweeps agree.
    least, tolerance = 0.006 * 4 * np.pi * len(views), 0.05
    found = _level_planes(points, UP, rng=rng, tolerance=tolerance, least=least)
    return [plane for plane in found if _bounds(points, plane, tolerance=tolerance)]


def _bounds(points: _Points, plane: ScenePlane, *, tolerance: float) -> bool:
    """Return whether more points are on a plane than beyond it, of those whose cameras are before it."""
    before = np.flatnonzero(points.centers @ plane.normal > plane.offset)
    with np.errstate(invalid="ignore"):
        errors = points.errors(plane.normal, plane.offset, before)
        faces = points.rays[before] @ plane.normal < 0
        on_it, beyond = np.abs(errors) < tolerance, errors < -2 * tolerance
    return bool(points.weight[before][faces & on_it].sum() >= points.weight[before][faces & beyond].sum())


@dataclass(eq=False)
class _Points:
    """Points of all views: positions, centres of their cameras, rays, normals (N, 3 each); `left` are still free."""

    xyz: FloatArray
    centers: FloatArray
    rays: FloatArray
    normals: FloatArray
    ranges: FloatArray
    uncertainty: FloatArray
    view: NDArray[np.int64]
    weight: FloatArray
    left: Mask

    def errors(self, normal: FloatArray, offset: float, chosen: NDArray[np.intp]) -> FloatArray:
        """Return the relative errors of ranges of some points if they were on a plane; NaN if it is grazing."""
        cosine = self.rays[chosen] @ normal
        cosine = np.where(np.abs(cosine) < 0.03, np.nan, cosine)
        return np.asarray((offset - self.centers[chosen] @ normal) / cosine / self.ranges[chosen] - 1)

    def on(self, normal: FloatArray, offset: float, chosen: NDArray[np.intp], *, tolerance: float) -> Mask:
        """Return which of some points are on a plane, and face its front."""
        with np.errstate(invalid="ignore"):
            near = np.abs(self.errors(normal, offset, chosen)) < tolerance
        return np.asarray(near & (self.normals[chosen] @ normal > _ALONG_NORMAL))

    def fit_weights(self, normal: FloatArray, chosen: NDArray[np.intp]) -> FloatArray:
        """Return the weights of some points in the fit of a plane: inverse variances of their distances to it."""
        height = np.abs((self.xyz[chosen] - self.centers[chosen]) @ normal)
        std = np.maximum(self.uncertainty[chosen], LEAST_UNCERTAINTY) * height
        return np.asarray(self.weight[chosen] / np.maximum(std, 1e-12) ** 2)

    def take(self, plane: ScenePlane, tolerance: float) -> None:
        """Remove the points of a plane from those that are left."""
        every = np.arange(len(self.xyz))
        self.left &= ~self.on(plane.normal, plane.offset, every, tolerance=2 * tolerance)


def _drawn_points(views: Sequence[PlaneView], rng: np.random.Generator) -> _Points | None:
    """Return points drawn by their weights, which are equal afterwards; None if there is none."""
    parts = [_points_of(view, number) for number, view in enumerate(views)]
    arrays = {name.name: np.concatenate([getattr(part, name.name) for part in parts]) for name in fields(_Points)}
    weight = arrays["weight"]
    total = float(weight.sum())
    if total <= 0:
        return None
    count = min(6000 * len(views), int(np.count_nonzero(weight)))
    chosen = rng.choice(len(weight), count, p=weight / total, replace=False)
    drawn = {name: array[chosen] for name, array in arrays.items()}
    return replace(_Points(**drawn), weight=np.full(count, total / count))


def _points_of(view: PlaneView, number: int) -> _Points:
    normals = _normals(view)
    seen = np.isfinite(view.ranges) & (view.confidence >= WEAK_CONFIDENCE[0]) & np.isfinite(normals).all(axis=-1)
    rays, ranges = view.rays[seen], view.ranges[seen]
    center = view.cam_from_world.center
    return _Points(
        xyz=center + rays * ranges[:, None],
        centers=np.broadcast_to(center, rays.shape),
        rays=rays,
        normals=normals[seen],
        ranges=ranges,
        uncertainty=view.uncertainty[seen],
        view=np.full(len(ranges), number),
        weight=view.area[seen],
        left=np.ones(len(ranges), np.bool_),
    )


def _normals(view: PlaneView, step: int = 3) -> FloatArray:
    """Return normals (h, w, 3) in the world, towards the camera, from ranges a few pixels apart; NaN if unknown."""
    points = view.rays * view.ranges[..., None]
    across = np.roll(points, -step, axis=1) - np.roll(points, step, axis=1)
    down = np.full_like(points, np.nan)
    down[step:-step] = points[2 * step :] - points[: -2 * step]
    normals = np.cross(across, down)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        behind = np.sum(normals * view.rays, axis=-1, keepdims=True) > 0
    return np.asarray(np.where(behind, -normals, normals))


def _level_planes(
    points: _Points, normal: FloatArray, *, rng: np.random.Generator, tolerance: float, least: float
) -> list[ScenePlane]:
    """Return the planes with a vertical normal, those with most support first, and take their points."""
    found: list[ScenePlane] = []
    while True:
        free = np.flatnonzero(points.left & (points.normals @ normal > _ALONG_NORMAL))
        if not len(free):
            return found
        drawn = rng.choice(free, 64)
        offsets = points.xyz[drawn] @ normal
        support = [
            points.weight[free][points.on(normal, offset, free, tolerance=tolerance)].sum() for offset in offsets
        ]
        best = int(np.argmax(support))
        if support[best] < least:
            return found
        offset = float(offsets[best])
        for _ in range(_FIT_ROUNDS):
            inliers = free[points.on(normal, offset, free, tolerance=tolerance)]
            offset = _weighted_median(points.xyz[inliers] @ normal, points.fit_weights(normal, inliers))
        found.append(_described(points, normal, offset, tolerance=tolerance, is_level=True))
        points.take(found[-1], tolerance)


def _upright_planes(points: _Points, *, rng: np.random.Generator, tolerance: float, least: float) -> list[ScenePlane]:
    """Return the planes with a horizontal normal, and take their points."""
    found: list[ScenePlane] = []
    while True:
        free = np.flatnonzero(points.left & (np.abs(points.normals[:, 1]) < np.sqrt(1 - _ALONG_NORMAL**2)))
        best, drawn = least, None
        some = free[:: max(1, len(free) // 4000)]
        share = len(some) / max(len(free), 1)
        for normal, offset in _drawn_upright(points, free, rng):
            support = float(points.weight[some][points.on(normal, offset, some, tolerance=tolerance)].sum()) / share
            if support > best:
                best, drawn = support, (normal, offset)
        if drawn is None:
            return found
        normal, offset = drawn
        for _ in range(_FIT_ROUNDS):
            inliers = free[points.on(normal, offset, free, tolerance=tolerance)]
            normal, offset = _fitted_upright(points, inliers, normal=normal, offset=offset)
        found.append(_described(points, normal, offset, tolerance=tolerance, is_level=False))
        points.take(found[-1], tolerance)
        if found[-1].support < least:  # a fit that lost its points would be found again
            points.left[free[points.on(*drawn, free, tolerance=tolerance)]] = False
            found.pop()


def _drawn_upright(points: _Points, free: NDArray[np.intp], rng: np.random.Generator) -> list[tuple[FloatArray, float]]:
    """Return upright planes through two points of one view that are a few degrees to 25° apart."""
    if len(free) < 2:
        return []
    found = []
    for first in rng.choice(free, 200):
        others = free[points.view[free] == points.view[first]]
        cosine = points.rays[others] @ points.rays[first]
        others = others[(cosine > _PAIR_COSINES[0]) & (cosine < _PAIR_COSINES[1])]
        if not len(others):
            continue
        x, _, z = points.xyz[rng.choice(others)] - points.xyz[first]
        length = np.hypot(x, z)
        if length == 0:
            continue
        normal = np.array([-z, 0.0, x]) / length
        normal = -normal if normal @ points.rays[first] > 0 else normal
        if normal @ points.normals[first] > _ALONG_NORMAL:
            found.append((normal, float(points.xyz[first] @ normal)))
    return found


def _fitted_upright(
    points: _Points, inliers: NDArray[np.intp], *, normal: FloatArray, offset: float
) -> tuple[FloatArray, float]:
    """Return an upright plane after one step of reweighted least squares with Cauchy weights."""
    if len(inliers) < 3:
        return normal, offset
    weights = points.fit_weights(normal, inliers)
    errors = np.abs(points.errors(normal, offset, inliers))
    weights = weights / (1 + (errors / max(1.5 * float(np.median(errors)), 1e-9)) ** 2)
    plan = points.xyz[inliers][:, [0, 2]]
    mean = weights @ plan / weights.sum()
    centred = plan - mean
    _, vectors = np.linalg.eigh((centred * weights[:, None]).T @ centred)
    fitted = np.array([vectors[0, 0], 0.0, vectors[1, 0]])
    fitted = fitted if fitted @ normal > 0 else -fitted
    return fitted, float(mean @ fitted[[0, 2]])


def _described(points: _Points, normal: FloatArray, offset: float, *, tolerance: float, is_level: bool) -> ScenePlane:
    """Return a plane with its support, and the uncertainty that its points have on average.

    They have much of their errors in common, so that many points are no more certain than one.
    """
    every = np.flatnonzero(points.left)
    inliers = every[points.on(normal, offset, every, tolerance=tolerance)]
    information = np.maximum(points.uncertainty[inliers], LEAST_UNCERTAINTY) ** -2.0
    return ScenePlane(
        normal,
        offset,
        support=float(points.weight[inliers].sum()),
        uncertainty=float(np.mean(information) ** -0.5) if len(inliers) else tolerance,
        is_level=is_level,
    )


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


@checks_settings
def find_structure(
    poses: Poses,
    range_maps: Mapping[str, RangeMap],
    load: Callable[[str], Picture],
    *,
    rng: np.random.Generator,
    threads: int = 1,
    max_relative_error: Annotated[float, Setting("maximum relative error of a range on a plane", gt=0, le=1)] = 0.02,
    min_share: Annotated[
        float, Setting("least extent of a plane, as a share of the sphere, in the mean over the views", gt=0, le=1)
    ] = 0.006,
) -> Structure:
    """Find the level and upright planes of a place, and the mirrors on these.

    A group of poses whose world is not known to be level has no planes.

    Args:
        poses: of all views.
        range_maps: by name, those of all views that have one.
        load: returns the panorama of a view, (H, W, 3) RGB.
        rng: draws points and planes.
        threads: number of threads, of which four are used: each holds a picture, 250 MB at 4096 columns.
    """
    threads = min(threads, 4)
    planes, groups, mirrors, mirror_groups = [], [], [], []
    for number, group in enumerate(split_groups(poses)):
        named = [(idx, name) for idx, name in enumerate(group.names) if name in range_maps]
        if not named or not group.axes.is_level:
            continue
        views = [
            plane_view(range_maps[name], lambda name=name: load(name), group.cam_from_world(idx))  # type: ignore[misc]
            for idx, name in named
        ]
        share = min_share * len(views)
        found = find_planes(views, rng=rng, max_relative_error=max_relative_error, min_share=share, threads=threads)
        planes += found
        groups += [number] * len(found)
        panes = find_mirrors(views, found, threads=threads)
        mirrors += panes
        mirror_groups += [number] * len(panes)
    return Structure(
        np.array([plane.normal for plane in planes]).reshape(-1, 3),
        np.array([plane.offset for plane in planes], np.float64),
        np.array([plane.uncertainty for plane in planes], np.float64),
        np.array(groups, np.int32),
        np.array(mirrors, np.float64).reshape(-1, 4, 3),
        np.array(mirror_groups, np.int32),
    )
