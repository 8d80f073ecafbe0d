"""Points of many range maps with the views that see them, to initialise Gaussian splatting."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.agreement import MAX_REPROJECTION_PX, MAX_SURFACE_STEP, pixels_containing
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, ray_from_pixel, spiral_rays
from pano_mvs.scene import Poses, RangeMap
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.scene.surfaces import SurfaceSamples, TrackedPoints


@checks_settings
def sample_surface(
    image: NDArray[np.uint8],
    valid: NDArray[np.bool_],
    range_map: RangeMap,
    *,
    count: Annotated[int, Setting("number of evenly spread directions to sample in each view", ge=1)] = 80_000,
    min_confidence: Annotated[
        int, Setting("minimum confidence of ranges (128: consistent)", ge=1, le=255)
    ] = CONSISTENT_CONFIDENCE[0],
) -> SurfaceSamples:
    """Return points of the surfaces that a view sees, one for each of `count` evenly spread directions.

    The density of samples is uniform on the sphere; a point is on the ray through its pixel's centre. Directions that
    are masked or have no range of sufficient confidence give no point, and no pixel gives two.

    Args:
        image: (H, W, 3) uint8 RGB.
        valid: (H, W) bool; False is ignored.
        range_map: of the same size.

    Raises:
        UsageError: if the sizes differ.
    """
    size_hw = (range_map.range.shape[0], range_map.range.shape[1])
    if image.shape[:2] != size_hw or valid.shape != size_hw:
        raise UsageError(f"image {image.shape[:2]}, mask {valid.shape} and range map {size_hw} differ in size")
    row, column = pixels_containing(spiral_rays(count), size_hw)
    pixels = np.unique(row * size_hw[1] + column)
    row, column = np.divmod(pixels, size_hw[1])
    good = valid[row, column] & (range_map.confidence[row, column] >= min_confidence) & range_map.valid[row, column]
    row, column = row[good], column[good]
    return SurfaceSamples(
        bearings=ray_from_pixel(np.stack([column + 0.5, row + 0.5], axis=-1), size_hw),
        ranges=np.asarray(range_map.range[row, column], np.float32),
        colors_rgb=np.asarray(image[row, column], np.uint8),
        confidence=np.asarray(range_map.confidence[row, column], np.uint8),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Points of all views: in the world (M, 3), index of the source view (M,), colour (M, 3)."""

    points: FloatArray
    home_idx: NDArray[np.int32]
    colors_rgb: NDArray[np.uint8]

    def __getitem__(self, keep: NDArray[np.intp]) -> _Candidates:
        return _Candidates(self.points[keep], self.home_idx[keep], self.colors_rgb[keep])


@dataclass(frozen=True, slots=True, eq=False)
class _Sightings:
    """Visibility: index of the point and of the view (T,), unit ray in the view (T, 3), error in radians (T,)."""

    point_idx: NDArray[np.intp]
    view_idx: NDArray[np.intp]
    bearings: FloatArray
    errors_rad: FloatArray


@checks_settings
def track_points(
    samples: Mapping[str, SurfaceSamples],
    poses: Poses,
    load_range: Callable[[str], RangeMap],
    *,
    rng: np.random.Generator,
    count: Annotated[int, Setting("number of points of all views together", ge=1)] = 100_000,
    min_views: Annotated[int, Setting("minimum number of views that see a point", ge=1)] = 2,
    neighbours: Annotated[int, Setting("number of nearest views to test for each point", ge=1)] = 16,
    max_relative_error: Annotated[float, Setting("maximum relative difference of ranges that agree", gt=0)] = 0.02,
    min_confidence: Annotated[int, Setting("minimum confidence of ranges that see a point", ge=1, le=255)] = 64,
) -> TrackedPoints:
    """Select evenly distributed points of range maps, each with the views that see it.

    Points are selected (`spread_points`) so that the distance between neighbours is proportional to the square root of
    the distance to the nearest camera. A view sees a point if its own range there agrees, forward and backward, by the
    test of `check_consistency`, with a confidence of at least `min_confidence`; occluded or masked points do not agree.
    Groups of poses get points in proportion to their number of views, each in its own world frame; no point is seen
    from two groups.

    Args:
        samples: image name to points of its surfaces.
        poses: poses of the images; images without a pose are ignored.
        load_range: image name to its range map; called once for each.
        rng: draws excess points.

    Raises:
        UsageError: if a setting is out of bounds.
    """
    groups = split_groups(poses)
    views = [sum(name in samples for name in group.names) for group in groups]
    found = []
    for group, own in zip(groups, views, strict=True):
        fewest = min(min_views, max(own, 1)) if len(groups) > 1 else min_views
        wanted = max(1, round(count * own / max(sum(views), 1)))
        points = _track_group(
            samples,
            group,
            load_range,
            rng=rng,
            count=wanted,
            min_views=fewest,
            neighbours=neighbours,
            max_relative_error=max_relative_error,
            min_confidence=min_confidence,
        )
        found.append(points)
    return _of_groups(found)


def _of_groups(parts: list[TrackedPoints]) -> TrackedPoints:
    """Return the points of all groups, one group after the other."""
    if len(parts) == 1:
        return parts[0]
    names = tuple(name for part in parts for name in part.names)
    first_point = np.cumsum([0, *(len(part) for part in parts)])
    first_image = np.cumsum([0, *(len(part.names) for part in parts)])
    points = [part.track_point_idx + np.int32(first) for part, first in zip(parts, first_point, strict=False)]
    images = [part.track_image_idx + np.int32(first) for part, first in zip(parts, first_image, strict=False)]
    return TrackedPoints(
        names=names,
        points_in_world=np.concatenate([part.points_in_world for part in parts]),
        colors_rgb=np.concatenate([part.colors_rgb for part in parts]),
        errors_rad=np.concatenate([part.errors_rad for part in parts]),
        track_point_idx=np.concatenate(points),
        track_image_idx=np.concatenate(images),
        track_bearings=np.concatenate([part.track_bearings for part in parts]),
    )


def _track_group(
    samples: Mapping[str, SurfaceSamples],
    poses: Poses,
    load_range: Callable[[str], RangeMap],
    *,
    rng: np.random.Generator,
    count: int,
    min_views: int,
    neighbours: int,
    max_relative_error: float,
    min_confidence: int,
) -> TrackedPoints:
    """Return the points of one group of poses."""
    names = [name for name in poses.names if name in samples]
    position = {name: idx for idx, name in enumerate(poses.names)}
    pose_idx = np.array([position[name] for name in names], np.intp)
    candidates = _candidates(samples, poses, names, pose_idx=pose_idx, rng=rng)
    if not len(candidates.points):
        return _tracked(names, candidates, _joined([]), kept=np.zeros(0, np.intp))
    centers = poses.centers[pose_idx]
    tree = scipy.spatial.cKDTree(centers)
    # Uniform density in space would be too coarse near cameras, uniform density in every view too coarse far away. So
    # the distance of neighbouring points is proportional to the square root of the distance to the nearest camera.
    spacing = np.maximum(np.asarray(tree.query(candidates.points)[0]), 1e-9) ** 0.5
    # Factor on the number of points that are tested for visibility, since some fail.
    few = spread_points(candidates.points, spacing, int(np.ceil(1.3 * count)), rng=rng)
    chosen, spacing = candidates[few], spacing[few]
    asked = _asked(tree, chosen, min(neighbours, len(names)))
    limits = np.array([max_relative_error, MAX_SURFACE_STEP, float(min_confidence)])
    found = [
        _sightings(
            chosen,
            asked[idx],
            idx,
            centers=centers,
            pose=poses.cam_from_world(pose_idx[idx]),
            range_map=load_range(name),
            limits=limits,
        )
        for idx, name in enumerate(names)
    ]
    sightings = _joined(found)
    kept = np.flatnonzero(np.bincount(sightings.point_idx, minlength=len(few)) >= min_views)
    return _tracked(
        names, chosen, sightings, kept=kept[spread_points(chosen.points[kept], spacing[kept], count, rng=rng)]
    )


def _candidates(
    samples: Mapping[str, SurfaceSamples],
    poses: Poses,
    names: list[str],
    *,
    pose_idx: NDArray[np.intp],
    rng: np.random.Generator,
) -> _Candidates:
    """Return the samples of all views in the world, thinned at random if there are too many."""
    share = min(1.0, 12_000_000 / max(sum(len(samples[name]) for name in names), 1))
    points, homes, colors = [np.zeros((0, 3))], [np.zeros(0, np.int32)], [np.zeros((0, 3), np.uint8)]
    for idx, name in enumerate(names):
        view = samples[name]
        kept = slice(None) if share == 1 else np.flatnonzero(rng.random(len(view)) < share)
        in_cam = view.bearings[kept] * view.ranges[kept].astype(np.float64)[:, None]
        points.append(poses.cam_from_world(int(pose_idx[idx])).inverse().apply(in_cam))
        homes.append(np.full(len(in_cam), idx, np.int32))
        colors.append(view.colors_rgb[kept])
    return _Candidates(np.concatenate(points), np.concatenate(homes), np.concatenate(colors))


def _asked(tree: scipy.spatial.cKDTree, chosen: _Candidates, neighbours: int) -> list[NDArray[np.intp]]:
    """Return for each view the points to test: those for which it is among the nearest views, and its own."""
    # A list of ranks, because for k=1 the query drops an axis.
    nearest = np.asarray(tree.query(chosen.points, k=list(range(1, neighbours + 1)))[1])
    point_idx = np.repeat(np.arange(len(nearest)), neighbours)
    view_idx = nearest.ravel()
    own = ~(nearest == chosen.home_idx[:, None]).any(axis=1)
    point_idx = np.concatenate([point_idx, np.flatnonzero(own)])
    view_idx = np.concatenate([view_idx, chosen.home_idx[own]])
    order = np.lexsort((point_idx, view_idx))
    ends = np.searchsorted(view_idx[order], np.arange(tree.n + 1))
    return [point_idx[order[first:end]] for first, end in pairwise(ends)]


def _sightings(
    chosen: _Candidates,
    asked: NDArray[np.intp],
    view_idx: int,
    *,
    centers: FloatArray,
    pose: Rigid3,
    range_map: RangeMap,
    limits: FloatArray,
) -> _Sightings:
    """Return which of the tested points a view sees."""
    from pano_mvs.algorithms.ranges.kernels_agreement import see_points  # compiles on import

    points, homes = np.ascontiguousarray(chosen.points[asked]), centers[chosen.home_idx[asked]]
    seen, errors, bearings = np.zeros(len(asked), np.bool_), np.zeros(len(asked)), np.zeros((len(asked), 3))
    max_angle = MAX_REPROJECTION_PX * 2 * np.pi / range_map.range.shape[1]
    # Copied, since the kernel is compiled once more for each combination of arrays that are read-only.
    view = np.array(pose.rotation, order="C"), np.array(pose.translation)
    ranges, confidence = np.array(range_map.range, order="C"), np.array(range_map.confidence, order="C")
    see_points(points, homes, max_angle, view, ranges, confidence, limits, seen, errors, bearings)
    views = np.full(int(seen.sum()), view_idx, np.intp)
    return _Sightings(asked[seen], views, bearings[seen], errors[seen])


def _joined(found: list[_Sightings]) -> _Sightings:
    none = np.zeros(0, np.intp)
    return _Sightings(
        np.concatenate([none, *(part.point_idx for part in found)]),
        np.concatenate([none, *(part.view_idx for part in found)]),
        np.concatenate([np.zeros((0, 3)), *(part.bearings for part in found)]),
        np.concatenate([np.zeros(0), *(part.errors_rad for part in found)]),
    )


def _tracked(names: list[str], chosen: _Candidates, sightings: _Sightings, *, kept: NDArray[np.intp]) -> TrackedPoints:
    """Return the selected points with their tracks, in the order of the views."""
    total = len(chosen.points)
    number = np.full(total, -1, np.int32)
    number[kept] = np.arange(len(kept), dtype=np.int32)
    # The view that a point comes from determines its position: its zero error proves nothing.
    others = sightings.view_idx != chosen.home_idx[sightings.point_idx]
    errors = np.bincount(sightings.point_idx[others], sightings.errors_rad[others], minlength=total)
    confirming = np.bincount(sightings.point_idx[others], minlength=total)
    of_kept = number[sightings.point_idx] >= 0
    return TrackedPoints(
        names=tuple(names),
        points_in_world=chosen.points[kept],
        colors_rgb=chosen.colors_rgb[kept],
        errors_rad=(errors / np.maximum(confirming, 1))[kept].astype(np.float32),
        track_point_idx=number[sightings.point_idx[of_kept]],
        track_image_idx=sightings.view_idx[of_kept].astype(np.int32),
        track_bearings=sightings.bearings[of_kept],
    )


_LEVELS_PER_OCTAVE = 3
# Odd numbers without structure, to hash the positions of voxels to 64-bit numbers.
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93], np.uint64)


def spread_points(
    points: NDArray[np.float64], spacing: NDArray[np.float64], count: int, *, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Select `count` points whose distances to their neighbours are proportional to `spacing`.

    There are two steps, each with the largest width, to about 2 %, that leaves enough points. First, space is divided
    into voxels with edges proportional to the spacing, rounded to one of a few sizes, and the point nearest to each
    voxel's centre is kept, about 2.5 times the wanted number. Then, in random order, a point is kept unless a kept one
    is closer than a disc's radius, which is proportional to the spacing (Poisson discs: Cook, "Stochastic sampling in
    computer graphics", 1986). The remaining excess is removed at random.

    `points`: (M, 3). `spacing`: (M,) wanted distance to the neighbours at each point, in any unit: only ratios matter.
    `count`: number of points to keep; all, if there are fewer. `rng`: draws the order and the excess.

    Returns:
        (min(count, M),) positions in `points`, ascending.

    Raises:
        UsageError: if shapes disagree or a spacing is not positive.
    """
    if points.ndim != 2 or spacing.shape != (len(points),) or not (spacing > 0).all() or count < 1:
        raise UsageError("spread_points needs points (M, 3), as many positive spacings, and a positive count")
    kept = _one_per_voxel(points, spacing, int(np.ceil(2.5 * count)))
    if len(kept) > count:
        kept = kept[_discs(points[kept], spacing[kept], count, rng=rng)]
    dropped = rng.permutation(len(kept))[count:]
    return np.sort(np.delete(kept, dropped))


def _widest(low: float, high: float, wanted: int, *, left: Callable[[float], int]) -> float:
    """Return the largest width between two limits, to about 2 %, that leaves enough points; `left` is decreasing."""
    for _ in range(24):
        middle = float(np.sqrt(low * high))
        found = left(middle)
        if found < wanted:
            high = middle
            continue
        low = middle
        if found <= wanted * 1.02:
            break
    return low


def _one_per_voxel(points: NDArray[np.float64], spacing: NDArray[np.float64], wanted: int) -> NDArray[np.intp]:
    if len(points) <= wanted:
        return np.arange(len(points))
    levels = np.rint(_LEVELS_PER_OCTAVE * np.log2(spacing / spacing.min()))
    edges = np.exp2(levels / _LEVELS_PER_OCTAVE)
    extent = max(float(np.ptp(points, axis=0).max()), 1e-9)
    width = _widest(1e-7 * extent, 2 * extent, wanted, left=lambda width: _occupied(points, edges * width, levels))
    return _nearest_to_centers(points, edges * width, levels)


def _discs(
    points: NDArray[np.float64], spacing: NDArray[np.float64], wanted: int, *, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Return points of which no two are closer than the smaller of their discs' radii."""
    order = rng.permutation(len(points))
    ranks = list(range(2, min(16, len(points)) + 1))  # points are on surfaces, where no more fit around one
    distance, neighbour = (np.asarray(found) for found in scipy.spatial.cKDTree(points).query(points, k=ranks))
    first = np.repeat(np.arange(len(points)), distance.shape[1])
    second = neighbour.ravel()
    width = distance.ravel() / np.minimum(spacing[first], spacing[second])
    later = order[first] > order[second]  # each pair occurs once or twice, once with the later one first
    first, second = np.where(later, first, second), np.where(later, second, first)

    def left(radius: float) -> NDArray[np.intp]:
        close = width < radius
        return _undisturbed(first[close], second[close], len(points))

    low = max(float(width.min()), 1e-12)
    return left(_widest(0.5 * low, 2 * float(width.max()), wanted, left=lambda radius: len(left(radius))))


def _undisturbed(later: NDArray[np.intp], earlier: NDArray[np.intp], total: int) -> NDArray[np.intp]:
    """Return the points to keep, given conflicting pairs: the earlier one is kept unless it was removed before."""
    stays, open_ = np.zeros(total, np.bool_), np.ones(total, np.bool_)
    while open_.any():
        waits = np.zeros(total, np.bool_)
        waits[later] = True
        safe = open_ & ~waits
        stays |= safe
        open_ &= ~safe
        open_[later[safe[earlier]]] = False
        alive = open_[later] & open_[earlier]
        later, earlier = later[alive], earlier[alive]
    return np.flatnonzero(stays)


def _voxels(points: NDArray[np.float64], edges: NDArray[np.float64], levels: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return a hash of the voxel of each point; collisions are practically impossible."""
    places = np.concatenate([np.floor(points / edges[:, None]), levels[:, None]], axis=1)
    keys = np.zeros(len(points), np.uint64)
    for axis in range(4):
        keys = (keys ^ places[:, axis].astype(np.int64).view(np.uint64)) * _MIX[axis]
        keys ^= keys >> np.uint64(29)
    return keys


def _occupied(points: NDArray[np.float64], edges: NDArray[np.float64], levels: NDArray[np.float64]) -> int:
    keys = np.sort(_voxels(points, edges, levels))
    return int((np.diff(keys) != 0).sum()) + 1


def _nearest_to_centers(
    points: NDArray[np.float64], edges: NDArray[np.float64], levels: NDArray[np.float64]
) -> NDArray[np.intp]:
    """Return the point nearest to the centre of each occupied voxel, the first one for ties."""
    place = points / edges[:, None]
    distance = np.square(place - np.floor(place) - 0.5).sum(axis=1)
    keys = _voxels(points, edges, levels)
    order = np.lexsort((distance, keys))
    first = np.ones(len(order), np.bool_)
    first[1:] = np.diff(keys[order]) != 0
    return order[first]
