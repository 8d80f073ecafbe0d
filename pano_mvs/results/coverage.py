"""What each camera of a run sees, and what no other camera sees, from small copies of the range maps."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray, pixel_solid_angle, ray_grid
from pano_mvs.results.records import Direction
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

VERSION = 1  # raise it when the figures change: those of earlier pages are then computed again
_POINTS_HW, _SURFACES_HW = (32, 64), (64, 128)
# A point is hidden from a camera if a surface is nearer by more than this share of its distance.
_TOLERANCE = 0.1


@dataclass(frozen=True)
class LonelyArea:
    """An area that only one camera sees."""

    azimuth_deg: float  # of its middle, in the image: 0 is the centre, positive to the right
    elevation_deg: float  # of its middle, positive above the horizon
    share: float  # of the sphere around the camera
    distance: float  # median range, in the unit of the camera's world
    at: Direction  # its middle in the world


@dataclass(frozen=True)
class ViewCoverage:
    """What one camera sees."""

    typical_range: float  # median range by solid angle, in the unit of the camera's world
    alone: float  # share of the sphere that no other camera sees
    # the largest connected parts of that, at most two, each at least 2 % of the sphere
    areas: tuple[LonelyArea, ...] = ()


@dataclass(frozen=True, eq=False)
class _Small:
    """A small copy of a view: ranges of points (h, w), and the farthest surfaces around each pixel (H, W)."""

    points: FloatArray
    surfaces: FloatArray
    pose: Rigid3


def coverage(values: StoredValues, names: Sequence[str]) -> dict[str, ViewCoverage]:
    """Return what some views of a run see; each is compared with its eight nearest cameras that have a range map.

    Args:
        names: of the views; those without a range map or a pose are left out.
    """
    poses = values.poses
    known = values.refs.get("ranges", {})
    if poses is None:
        return {}
    small: dict[str, _Small | None] = {}
    found = {}
    for group in split_groups(poses):
        with_ranges = [idx for idx, name in enumerate(group.names) if name in known]
        for idx in with_ranges:
            name = group.names[idx]
            if name not in names:
                continue
            near = _nearest(group, idx, with_ranges)
            views = [_cached(small, values, at, group=group) for at in (idx, *near)]
            own, others = views[0], [view for view in views[1:] if view is not None]
            if own is not None and np.isfinite(own.points).any():
                found[name] = view_coverage(own.points, own.pose, [(view.surfaces, view.pose) for view in others])
    return found


_FACT = TypeAdapter(dict[str, ViewCoverage])


def fact_of(found: Mapping[str, ViewCoverage]) -> dict[str, Any]:
    """Return what views see as a JSON value."""
    return {name: asdict(view) for name, view in found.items()}


def coverage_from_fact(fact: Any) -> dict[str, ViewCoverage]:
    """Return what views see from the value of `fact_of`."""
    return _FACT.validate_python(fact)


def coverage_key(values: StoredValues, names: Sequence[str]) -> str:
    """Return a key of the inputs of `coverage`; it changes if poses or range maps of these views do."""
    inputs = [values.digest("poses"), *(f"{name} {values.digest('ranges', name)}" for name in names)]
    return f"{zlib.crc32(chr(10).join(inputs).encode()):08x}.{len(names)}.a{VERSION}"


def view_coverage(ranges: FloatArray, pose: Rigid3, others: Sequence[tuple[FloatArray, Rigid3]]) -> ViewCoverage:
    """Return what a camera sees and others do not.

    Args:
        ranges: (h, w), NaN where there is none; at least one is finite.
        pose: cam_from_world.
        others: ranges (H, W) and poses of other cameras; where a range is NaN, it is unknown what the camera sees, and
            it counts as seen.
    """
    weights = np.broadcast_to(pixel_solid_angle((ranges.shape[0], ranges.shape[1]))[:, None], ranges.shape) / (
        4 * np.pi
    )
    valid = np.isfinite(ranges)
    order = np.argsort(ranges[valid])
    middle = np.searchsorted(np.cumsum(weights[valid][order]), weights[valid].sum() / 2)
    typical = float(ranges[valid][order][min(int(middle), len(order) - 1)])
    alone = seen_alone(ranges, pose, others)
    areas = _areas(alone, ranges, pose, weights=weights)
    return ViewCoverage(typical, float(weights[alone].sum()), areas)


def seen_alone(ranges: FloatArray, pose: Rigid3, others: Sequence[tuple[FloatArray, Rigid3]]) -> Mask:
    """Return the pixels (h, w) with a range whose points are hidden from all others; none if there is no other."""
    alone = np.isfinite(ranges)
    if not others:
        return np.zeros(ranges.shape, np.bool_)
    rays = ray_grid((ranges.shape[0], ranges.shape[1]))
    points = pose.inverse().apply(rays * np.where(alone, ranges, 1.0)[..., None])
    for surfaces, other in others:
        in_other = other.apply(points)
        distance = np.linalg.norm(in_other, axis=-1)
        xy = pixel_from_ray(in_other / np.maximum(distance, 1e-12)[..., None], (surfaces.shape[0], surfaces.shape[1]))
        row = np.clip(xy[..., 1].astype(np.int64), 0, surfaces.shape[0] - 1)
        limit = surfaces[row, xy[..., 0].astype(np.int64) % surfaces.shape[1]]
        alone &= distance > limit * (1 + _TOLERANCE)  # False if the limit is NaN
    return np.asarray(alone, np.bool_)


def _areas(alone: Mask, ranges: FloatArray, pose: Rigid3, *, weights: NDArray[np.floating]) -> tuple[LonelyArea, ...]:
    labels = _labels(alone)
    shares = np.bincount(labels.ravel(), weights.ravel(), minlength=1)
    shares[0] = 0
    found = []
    for label in np.argsort(-shares)[:2]:
        if shares[label] < 0.02:
            break
        inside = labels == label
        rays = ray_grid((alone.shape[0], alone.shape[1]))[inside]
        middle = (rays * weights[inside][:, None]).sum(axis=0)
        # The middle of an area that surrounds something may lie outside: take the ray of the area nearest to it.
        ray = rays[int(np.argmax(rays @ middle))]
        distance = float(np.median(ranges[inside]))
        x, y, z = (float(value) for value in pose.inverse().apply(ray * distance))
        azimuth, elevation = np.arctan2(ray[0], ray[2]), np.arctan2(-ray[1], np.hypot(ray[0], ray[2]))
        share = float(shares[label])
        found.append(LonelyArea(float(np.rad2deg(azimuth)), float(np.rad2deg(elevation)), share, distance, (x, y, z)))
    return tuple(found)


def _labels(pixels: Mask) -> NDArray[np.int64]:
    """Return the connected areas of a panorama (h, w), numbered from 1, joined across the seam; 0 elsewhere."""
    _, labels = cv2.connectedComponents(pixels.astype(np.uint8), connectivity=4)
    result = np.asarray(labels, np.int64)
    for row in result:
        first, last = row[0], row[-1]
        if first and last and first != last:
            result[result == last] = first
    return result


def _nearest(group: Poses, idx: int, with_ranges: Sequence[int]) -> list[int]:
    others = [at for at in with_ranges if at != idx]
    distances = np.linalg.norm(group.centers[others] - group.centers[idx], axis=1)
    return [others[at] for at in np.argsort(distances, kind="stable")[:8]]


def _cached(small: dict[str, _Small | None], values: StoredValues, idx: int, *, group: Poses) -> _Small | None:
    name = group.names[idx]
    if name not in small:
        ranges, confidence = values.ranges(name), values.confidence(name)
        if ranges is None or confidence is None or ranges.shape != confidence.shape:
            small[name] = None
        else:
            small[name] = _reduced(ranges, confidence, group.cam_from_world(idx))
    return small[name]


def _reduced(all_ranges: NDArray[np.float32], confidence: NDArray[np.uint8], pose: Rigid3) -> _Small:
    sampled = {}
    for size_hw in (_POINTS_HW, _SURFACES_HW):
        rows, columns = (
            ((np.arange(size) + 0.5) * side / size).astype(np.int64)
            for size, side in zip(size_hw, all_ranges.shape, strict=True)
        )
        ranges = np.asarray(all_ranges[rows[:, None], columns], np.float64)
        seen = np.asarray(confidence[rows[:, None], columns]) >= WEAK_CONFIDENCE[0]
        sampled[size_hw] = np.where(seen, ranges, np.nan)
    surfaces = pad_panorama(sampled[_SURFACES_HW], 1)
    height, width = _SURFACES_HW
    around = [surfaces[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return _Small(sampled[_POINTS_HW], np.max(around, axis=0), pose)  # NaN where any of them is
