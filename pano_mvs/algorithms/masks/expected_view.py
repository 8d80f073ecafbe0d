"""What the other views of a capture let one expect of a panorama: surfaces, and their colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import DARK_LEVEL
from pano_mvs.algorithms.panoramas import filtered, mean_around, nearest_resized, square_window
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.geometry import Rigid3, pad_panorama, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE

Plane = NDArray[np.float32]

# Ranges that agree within this share are of one surface.
_SAME = 0.06
_MIN_GROUND_POINTS = 150


@dataclass(frozen=True, slots=True, eq=False)
class OtherView:
    """Another view of the capture.

    `picture`: (H, W, 3) uint8 RGB. `valid`: (H, W), False is ignored. `range_map`: its ranges, of any size. `pose`:
    source_from_reference.
    """

    picture: Picture
    valid: Mask
    range_map: RangeMap
    pose: Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What other views expect of a panorama, (H, W) each."""

    ranges: Plane  # where they put the nearest surface; NaN if they do not know
    ground: Mask  # whether that is the ground
    # by how many grey levels the panorama's colour differs from all that the views show there and around it, NaN unless
    # two of them see the surface
    difference: Plane
    ratio: Plane  # (H, W, 3) the panorama's colours on the ground divided by the median of theirs; NaN elsewhere
    height: float  # the camera's height above the ground, in scene units; NaN if it is not known


def expected_view(picture: Picture, range_map: RangeMap, others: Sequence[OtherView]) -> Expected:
    """Compare a panorama with what other views expect in it.

    A surface is expected where the ranges of two of them agree, or on the plane of the ground. The colours of those
    that see it, after a factor per channel, and the lightest and the darkest colours within 1.4°, are what can be
    expected there.

    `picture`: (H, W, 3) uint8 RGB, the reference. `range_map`: its ranges, of the same size. `others`: views around it,
    of the same size.
    """
    size_hw = (picture.shape[0], picture.shape[1])
    grid_hw = (size_hw[0] // 2, size_hw[1] // 2)
    seen = np.array([_projected_ranges(other, grid_hw) for other in others])
    known = np.where(range_map.confidence >= CONSISTENT_CONFIDENCE[0], range_map.range, np.float32(np.nan))
    plane = ground_plane(known, seen)
    ranges = _agreed(seen)
    on_ground = np.full(grid_hw, np.nan, np.float32)
    if plane is not None:
        along = ray_grid(grid_hw) @ plane[:3]
        on_ground = np.where(along > np.sin(np.radians(8)), plane[3] / np.maximum(along, 1e-6), np.nan).astype(
            np.float32
        )
    ground = ~(ranges < (1 - 2 * _SAME) * on_ground) & np.isfinite(on_ground)
    ranges = nearest_resized(np.where(ground, on_ground, ranges), size_hw)
    ground = nearest_resized(ground.astype(np.float32), size_hw) > 0.5
    colors, own = [_colors_around(other.picture) for other in others], mean_around(picture)
    difference, expected = _differences(own, ranges, others, around=colors, colors_at=ground)
    ratio = (own + DARK_LEVEL) / (expected + DARK_LEVEL)
    height = float("nan") if plane is None else float(plane[3])
    return Expected(ranges, ground, difference, ratio, height)


def ground_plane(known: Plane, seen: Plane) -> FloatArray | None:
    """Return the plane of the ground, n·x = h with n nearly straight down, as (4,): n and h; None without one.

    `known`: (H, W) ranges of the panorama; NaN is unknown. `seen`: (V, h, w) ranges as other views see them from there.
    """
    points = np.concatenate([_low_points(ranges) for ranges in (known, *seen)])
    if len(points) < _MIN_GROUND_POINTS:
        return None
    rng = np.random.default_rng(0)
    points = points[rng.permutation(len(points))[:3000]]
    best: FloatArray | None = None
    most = _MIN_GROUND_POINTS
    for _ in range(60):
        plane = _plane_through(points[rng.choice(len(points), 3, replace=False)])
        if plane is None:
            continue
        count = int((np.abs(points @ plane[:3] - plane[3]) < 0.03 * plane[3]).sum())
        if count > most:
            best, most = plane, count
    return best


def _low_points(ranges: Plane) -> FloatArray:
    rays = ray_grid((ranges.shape[0], ranges.shape[1]))
    # The ground is a plane through points this far below the horizon, and tilted by no more.
    low = np.isfinite(ranges) & (rays[..., 1] > np.sin(np.radians(20.0)))
    return np.asarray(rays[low] * ranges[low, None])


def _plane_through(three: FloatArray) -> FloatArray | None:
    normal = np.cross(three[1] - three[0], three[2] - three[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-9:
        return None
    normal /= length * np.sign(normal[1] or 1)
    height = float(normal @ three[0])
    return np.append(normal, height) if normal[1] > np.cos(np.radians(20.0)) and height > 0 else None


def _projected_ranges(other: OtherView, grid_hw: tuple[int, int]) -> Plane:
    """Return the nearest ranges (h, w) that another view's points have from the reference; NaN where there are none."""
    ranges = np.where(other.range_map.confidence >= WEAK_CONFIDENCE[0], other.range_map.range, np.float32(np.nan))
    known = np.isfinite(ranges)
    points = ray_grid((ranges.shape[0], ranges.shape[1]))[known].T * ranges[known]
    points = other.pose.rotation.T @ (points - other.pose.translation[:, None])
    distances = np.sqrt(points[0] ** 2 + points[1] ** 2 + points[2] ** 2)
    nearest = np.full(grid_hw, np.inf, np.float32)
    np.minimum.at(nearest, pixels_containing(points.T, grid_hw), distances.astype(np.float32))
    found = np.where(np.isfinite(nearest), nearest, np.float32(0))
    padded = pad_panorama(found, 1)
    count = cv2.blur((padded > 0).astype(np.float32), (3, 3))[1:-1, 1:-1]
    mean = cv2.blur(padded, (3, 3))[1:-1, 1:-1] / np.maximum(count, 1e-6)
    filled = np.where(count >= 2.5 / 9, mean, np.float32(np.nan))
    return np.asarray(np.where(found > 0, found, filled), np.float32)


def _agreed(seen: Plane) -> Plane:
    """Return the nearest ranges (h, w) on which two views agree; NaN where none do."""
    best = np.full(seen.shape[1:], np.inf, np.float32)
    for idx in range(len(seen)):
        for other in range(len(seen)):
            if other != idx:
                with np.errstate(invalid="ignore"):
                    agrees = np.abs(seen[other] - seen[idx]) < _SAME * seen[idx]
                best = np.where(agrees & (seen[idx] < best), seen[idx], best)
    return np.asarray(np.where(np.isfinite(best), best, np.nan), np.float32)


def _differences(
    own: Plane, ranges: Plane, others: Sequence[OtherView], *, around: Sequence[Plane], colors_at: Mask
) -> tuple[Plane, Plane]:
    """Return the differences of colour and the expected colours of pixels; NaN where fewer than two, or no, views see.

    `own`: (H, W, 3) `mean_around` of the reference. `ranges`: (H, W), NaN if not known. `others`: the other views.
    `around`: `_colors_around` of each. `colors_at`: (H, W), where expected colours are wanted.

    Returns:
        (H, W) grey levels, and (H, W, 3).
    """
    known = np.isfinite(ranges)
    points = ray_grid((ranges.shape[0], ranges.shape[1]))[known].T * ranges[known]
    wanted, shown = colors_at[known], np.ascontiguousarray(own[known].T)
    differences = np.full((len(others), len(wanted)), np.nan, np.float32)
    colors = np.full((len(others), 3, int(wanted.sum())), np.nan, np.float32)
    for idx, (other, of_other) in enumerate(zip(others, around, strict=True)):
        at, visible = _seen_pixels(other, points)
        here = shown[:, visible]
        lowest, middle, highest = of_other[:, :, at[visible]]
        gain = np.ones((3, 1), np.float32)
        if visible.sum() > 100:
            gain = np.median((here + DARK_LEVEL) / (middle + DARK_LEVEL), axis=1, keepdims=True)
        apart = np.maximum(lowest * gain - here, here - highest * gain)
        # Three planes: the largest over a short last axis takes many times as long.
        differences[idx, visible] = np.maximum(np.maximum(np.maximum(*apart[:2]), apart[2]), 0)
        seen = np.full((3, len(wanted)), np.nan, np.float32)
        seen[:, visible] = middle * gain
        colors[idx] = seen[:, wanted]
    differences.sort(axis=0)  # NaN last
    count = np.isfinite(differences).sum(axis=0)
    # With four views or more, one may differ from the others by chance.
    which = np.where(count >= 4, 1, 0)
    least = np.take_along_axis(differences, which[None], axis=0)[0]
    difference, expected = np.full(known.shape, np.nan, np.float32), np.full(own.shape, np.nan, np.float32)
    difference[known] = np.where(count >= 2, least, np.float32(np.nan))
    # The median of the values that are not NaN, the lower one of two.
    ordered = np.sort(colors, axis=0)
    middle = np.maximum(np.isfinite(ordered).sum(axis=0) - 1, 0) // 2
    expected[known & colors_at] = np.asarray(np.take_along_axis(ordered, middle[None], axis=0)[0]).T
    return difference, expected


def _seen_pixels(other: OtherView, points: FloatArray) -> tuple[NDArray[np.intp], Mask]:
    """Return the pixels (N,) of another view, as flat indices, in which points (3, N) arrive, and which it sees."""
    in_view = other.pose.rotation @ points + other.pose.translation[:, None]
    distances = np.sqrt(in_view[0] ** 2 + in_view[1] ** 2 + in_view[2] ** 2)
    height, width = other.picture.shape[:2]
    row, column = pixels_containing(in_view.T, (height, width))
    at = row * width + column
    seen = nearest_resized(other.range_map.range, (height, width)).ravel()[at]
    with np.errstate(invalid="ignore"):
        visible = other.valid.ravel()[at] & ~(np.abs(seen - distances) > 2 * _SAME * distances)
    return at, visible


def _colors_around(picture: Picture) -> Plane:
    """Return the darkest, the mean and the lightest colours around each pixel, (3, 3, H W): which, colour and pixel."""
    smooth = mean_around(picture)
    # Views differ by a pixel or two where poses or ranges are not exact: colours within this angle count as well.
    around = max(1, round(1.4 * len(picture) / 180))
    window = square_window(around)
    darkest, lightest = (
        filtered(smooth, around, lambda padded, extreme=extreme: extreme(padded, window))  # type: ignore[misc]
        for extreme in (cv2.erode, cv2.dilate)
    )
    colors = np.stack([darkest, smooth, lightest])
    return np.ascontiguousarray(colors.reshape(3, -1, 3).transpose(0, 2, 1))
