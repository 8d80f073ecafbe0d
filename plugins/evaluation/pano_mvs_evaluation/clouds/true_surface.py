"""The true surface of a scene, as samples from true range maps or from a reference cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray, pixel_solid_angle, ray_grid

# A view sees a sample if the sample's distance lies within the four true ranges around it, give or take this share.
_SEEN_WITHIN = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class TrueView:
    """A view with true ranges."""

    cam_from_world: Rigid3  # its true pose
    range: NDArray[np.float32]  # (H, W) float32 true ranges in the truth's unit, NaN where there is no surface


@dataclass(frozen=True, slots=True, eq=False)
class TrueSurface:
    """Samples of a surface, each with the area that it represents."""

    points_in_world: NDArray[np.float32]  # (N, 3) float32
    area: NDArray[np.float64]  # (N,) float64, in squared units of the truth, or numbers of voxels
    view_idx: NDArray[np.int64]  # (N,) int64 the view from which each sample comes; 0 for a reference cloud
    # (N,) int64 its pixel there, row-major; the point's position in a reference cloud
    pixel_idx: NDArray[np.int64]


def view_points(view: TrueView) -> NDArray[np.float32]:
    """Return the surface points, (N, 3) in the world, of a view's pixels with a range, in row-major order.

    Rows away from the equator are thinned to an even density per solid angle.
    """
    height, width = view.range.shape
    samples = np.maximum(1, np.rint(width * np.sin(np.pi * (np.arange(height) + 0.5) / height)))
    number = np.floor(np.arange(width) * samples[:, None] / width)
    even: NDArray[np.bool_] = np.diff(number, axis=1, prepend=-1) > 0
    rows, columns = np.nonzero(np.isfinite(view.range) & even)
    return _points(view, rows, columns)


def surface_of_views(views: Sequence[TrueView], *, max_samples: int = 1_000_000) -> TrueSurface:
    """Return the part of the true surface that at least two of the views see, or the only one.

    A pixel of range r and solid angle Ω that meets the surface at the angle α to its normal represents the area
    Ω r² / cos α. Surface that k views see is sampled k times, with a k-th of the area each, so that it counts by its
    area, however near or often it was seen.

    Args:
        views: the views that were used.
        max_samples: pixels are skipped evenly to have at most this many samples.

    Raises:
        UsageError: if there are no views, or a range map is not (H, W) with even W.
    """
    if not views:
        raise UsageError("no view has ground truth, so the true surface is unknown")
    pixels = sum(view.range.size for view in views)
    step = max(1, int(np.ceil(np.sqrt(pixels / max_samples))))
    parts = [_samples(idx, views, step=step, min_views=min(2, len(views))) for idx in range(len(views))]
    return TrueSurface(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def surface_of_cloud(points_in_world: NDArray[np.float32], *, voxel_size: float) -> TrueSurface:
    """Return a reference cloud as a surface: the points of a voxel share the weight 1."""
    voxels = np.floor(points_in_world.astype(np.float64) / voxel_size).astype(np.int64)
    _, group, count = np.unique(voxels, axis=0, return_inverse=True, return_counts=True)
    idx = np.arange(len(points_in_world))
    return TrueSurface(points_in_world, 1 / count[group.reshape(-1)], np.zeros_like(idx), idx)


def _samples(
    view_idx: int, views: Sequence[TrueView], *, step: int, min_views: int
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return points, areas, view and pixel positions of one view's share of the surface."""
    view = views[view_idx]
    height, width = view.range.shape
    chosen = np.zeros((height, width), np.bool_)
    chosen[step // 2 :: step, step // 2 :: step] = True
    rows, columns = np.nonzero(chosen & np.isfinite(view.range))
    points = _points(view, rows, columns)
    seen = 1 + sum(_is_seen(points, other) for idx, other in enumerate(views) if idx != view_idx)
    cosine = _cosines(view.range)[rows, columns]
    solid_angle = step**2 * pixel_solid_angle((height, width))[rows]
    area = solid_angle * view.range[rows, columns].astype(np.float64) ** 2 / cosine / seen
    kept = np.broadcast_to(seen >= min_views, area.shape)
    pixel_idx = (rows * width + columns)[kept]
    return points[kept], area[kept], np.full_like(pixel_idx, view_idx), pixel_idx


def _cosines(ranges: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return |cos| of the angle, (H, W), at which each ray meets the surface, of ranges without noise.

    The surface is spanned by the steps to a neighbour in the row and one in the column; without neighbours, the ray
    counts as perpendicular.
    """
    rays = ray_grid((ranges.shape[0], ranges.shape[1]))
    points = pad_panorama(rays * ranges[..., None], 2)
    inverse = pad_panorama(1 / ranges.astype(np.float64), 2)
    across = _step_on_surface(points[2:-2], inverse[2:-2])
    down = _step_on_surface(points[:, 2:-2].swapaxes(0, 1), inverse[:, 2:-2].T).swapaxes(0, 1)
    normals = np.cross(across, down)
    length = np.linalg.norm(normals, axis=-1)
    cosine = np.abs(np.sum(rays * normals, axis=-1)) / np.where(length > 0, length, np.nan)
    # Surfaces seen at a flatter angle than this have no reliable area.
    return np.where(np.isfinite(cosine), cosine.clip(0.05), 1.0)


def _step_on_surface(points: NDArray[np.float64], inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the step, (H, W, 3), to the neighbour in the row on the side where the surface continues.

    On a plane the inverse range is nearly linear: the side where it is more linear is chosen.

    Args:
        points: (H, W + 4, 3), two columns of margin on either side.
        inverse: (H, W + 4) inverse ranges, NaN where there is no surface.
    """
    bend = np.abs(inverse[:, 2:] - 2 * inverse[:, 1:-1] + inverse[:, :-2])
    before, after = bend[:, :-2], bend[:, 2:]
    middle = points[:, 2:-2]
    # A side with a hole has a bend of NaN, and is chosen only if the other side has a hole too.
    use_before = (before <= after) | np.isnan(after)
    return np.where(use_before[..., None], middle - points[:, 1:-3], points[:, 3:-1] - middle)


def _points(view: TrueView, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float32]:
    rays = ray_grid((view.range.shape[0], view.range.shape[1]))[rows, columns]
    ranges = view.range[rows, columns].astype(np.float64)
    return view.cam_from_world.inverse().apply(rays * ranges[:, None]).astype(np.float32)


def _is_seen(points_in_world: NDArray[np.float32], view: TrueView) -> NDArray[np.bool_]:
    """Return whether a view sees each point, (N,): whether the view's own surface lies there."""
    height, width = view.range.shape
    in_cam = view.cam_from_world.apply(points_in_world.astype(np.float64))
    distance = np.linalg.norm(in_cam, axis=-1)
    pixel = pixel_from_ray(in_cam, (height, width)) - 0.5
    left, top = np.floor(pixel[:, 0]).astype(np.int64), np.floor(pixel[:, 1]).astype(np.int64)
    padded = pad_panorama(view.range, 1)
    corners = [padded[top + 1 + below, left + 1 + beside] for below in (0, 1) for beside in (0, 1)]
    nearest, farthest = np.fmin.reduce(corners), np.fmax.reduce(corners)
    seen: NDArray[np.bool_] = (nearest * (1 - _SEEN_WITHIN) <= distance) & (distance <= farthest * (1 + _SEEN_WITHIN))
    return seen
