"""From range maps to one cloud: points on which views agree, each written once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.consistency import seen_ranges
from pano_mvs.algorithms.fusion.normals import normals_from_range
from pano_mvs.algorithms.fusion.voxels import thin_by_voxels
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import PointCloud, RangeMap

_MAX_SURFACE_STEP = 0.05
_MAX_REPROJECTION_PX = 1.0
# Where two views see a surface about equally well the earlier one keeps it: it may be 5 % worse, and the later one must
# be 3 % better. The zone between the two is written twice, so that small errors of the footprints leave no gap.
_EARLIER_MAY_BE_WORSE, _LATER_MUST_BE_BETTER = 1.05, 0.97


@dataclass(frozen=True, slots=True, eq=False)
class FusionView:
    """One view of a fusion.

    Attributes:
        range_map: (H, W) range map.
        pose: cam_from_world.
        image: (H, W, 3) uint8 RGB.
    """

    range_map: RangeMap
    pose: Rigid3
    image: NDArray[np.uint8]


def fuse_views(
    views: Iterable[FusionView],
    *,
    min_views: int = 2,
    max_relative_error: float = 0.02,
    stride: int = 1,
    voxel_size: float | None = None,
    min_confidence: int = 64,
) -> PointCloud:
    """Return the cloud of all points on which at least `min_views` views agree.

    Each view in turn is the reference of `fuse_reference`, with all others as its sources; the clouds are joined in
    the order of the views.

    Args:
        views: the views; all are held in memory.
        min_views: how many views, the one that writes the point included, must agree.
        max_relative_error: largest relative difference of two views' ranges of one point.
        stride: write every stride-th pixel in both directions.
        voxel_size: edge, in scene units, of voxels in which points are joined into one; None joins none.
        min_confidence: pixels of a lower confidence neither write nor vote.

    Raises:
        UsageError: if a parameter is out of bounds, or a view's arrays disagree.
    """
    held = list(views)
    clouds = [
        fuse_reference(
            view,
            held[:idx],
            held[idx + 1 :],
            min_views=min_views,
            max_relative_error=max_relative_error,
            stride=stride,
            min_confidence=min_confidence,
        )
        for idx, view in enumerate(held)
    ]
    cloud = join_clouds(clouds)
    return cloud if voxel_size is None else thin_by_voxels(cloud, voxel_size)


def fuse_reference(
    reference: FusionView,
    earlier: Sequence[FusionView],
    later: Sequence[FusionView],
    *,
    min_views: int = 2,
    max_relative_error: float = 0.02,
    stride: int = 1,
    min_confidence: int = 64,
) -> PointCloud:
    """Return the points that one view contributes to the cloud.

    A pixel becomes a point if `min_views` views agree on it, by the test of `check_consistency`, and none of those that
    agree sees the surface with a clearly smaller footprint r² / cosine: that one will write it. Position and colour are
    averages over the agreeing views, weighted by 1 / r². Rows away from the equator are thinned so that pixels per
    solid angle are even. The result depends on the reference and the sources only, so a caller may hold just those.

    Args:
        reference: the view that writes.
        earlier: neighbouring views that come before it.
        later: neighbouring views that come after it.
        min_views: as in `fuse_views`.
        max_relative_error: as in `fuse_views`.
        stride: as in `fuse_views`.
        min_confidence: as in `fuse_views`.

    Returns:
        The points in the world frame, in the order of the reference's pixels.

    Raises:
        UsageError: if a parameter is out of bounds, or a view's arrays disagree.
    """
    if min_views < 1 or stride < 1 or not max_relative_error > 0:
        raise UsageError(f"min_views, stride and max_relative_error must be positive, got {min_views}, {stride}, "
                         f"{max_relative_error}")  # fmt: skip
    for view in (reference, *earlier, *later):
        if view.image.shape != (*view.range_map.range.shape, 3) or view.image.dtype != np.uint8:
            raise UsageError(f"a view's image must be (H, W, 3) uint8 in the size of its range map "
                             f"{view.range_map.range.shape}, got {view.image.shape} {view.image.dtype}")  # fmt: skip
    height, width = reference.range_map.range.shape
    ranges = seen_ranges(reference.range_map, min_confidence=min_confidence)
    rays = ray_grid((height, width))
    normals = _normals_or_views(ranges, rays)
    kept = np.isfinite(ranges) & _even_pixels((height, width), stride)
    ranges[~kept] = np.nan
    counts, sums, colors = _vote_of_sources(
        (ranges, rays, normals), reference, [(view, _EARLIER_MAY_BE_WORSE) for view in later]
        + [(view, _LATER_MUST_BE_BETTER) for view in earlier], kept, max_relative_error, min_confidence,
    )  # fmt: skip
    kept &= counts >= min_views
    weight = sums[kept][:, 3:]
    world_from_cam = reference.pose.inverse()
    return PointCloud(
        points_in_world=world_from_cam.apply(sums[kept][:, :3] / weight).astype(np.float32),
        normals_in_world=(normals[kept].astype(np.float64) @ world_from_cam.rotation.T).astype(np.float32),
        colors_rgb=np.rint(colors[kept] / weight).clip(0, 255).astype(np.uint8),
        view_counts=counts[kept],
    )


def join_clouds(clouds: Sequence[PointCloud]) -> PointCloud:
    """Return one cloud of the points of several, in order."""
    empty = np.zeros((0, 3), np.float32)
    return PointCloud(
        np.concatenate([empty, *(cloud.points_in_world for cloud in clouds)]),
        np.concatenate([empty, *(cloud.normals_in_world for cloud in clouds)]),
        np.concatenate([empty.astype(np.uint8), *(cloud.colors_rgb for cloud in clouds)]),
        np.concatenate([np.zeros(0, np.uint8), *(cloud.view_counts for cloud in clouds)]),
    )


def _vote_of_sources(
    pixels: tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32]],
    reference: FusionView,
    sources: Sequence[tuple[FusionView, float]],
    kept: NDArray[np.bool_],
    max_relative_error: float,
    min_confidence: int,
) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64]]:
    """Return counts, weighted points with weights, and weighted colours; clear `kept` where a source sees better."""
    from pano_mvs.algorithms.fusion.kernels_vote import vote  # compiles on import

    ranges, rays, _ = pixels
    weight = 1 / ranges.astype(np.float64) ** 2
    counts = np.isfinite(ranges).astype(np.uint8)
    sums = np.concatenate([rays * (weight * ranges)[..., None], weight[..., None]], axis=-1)
    colors = reference.image * weight[..., None]
    limits = np.array([max_relative_error, _MAX_REPROJECTION_PX * 2 * np.pi / ranges.shape[1], _MAX_SURFACE_STEP])
    for view, most_worse in sources:
        source_from_reference = view.pose @ reference.pose.inverse()
        source = (
            np.ascontiguousarray(source_from_reference.rotation),
            np.ascontiguousarray(source_from_reference.translation),
            seen_ranges(view.range_map, min_confidence=min_confidence),
            np.ascontiguousarray(view.image),
        )
        vote(pixels, source, limits, most_worse, (kept, counts, sums, colors))
    return counts, sums, colors


def _normals_or_views(ranges: NDArray[np.float32], rays: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return unit normals, (H, W, 3); where no plane is defined, the direction to the camera."""
    normals = normals_from_range(ranges)
    return np.where(np.isfinite(normals), normals, -rays).astype(np.float32)


def _even_pixels(size_hw: tuple[int, int], stride: int) -> NDArray[np.bool_]:
    """Return the pixels, (H, W), that sample the sphere evenly: in a row at elevation φ the share cos φ of them."""
    height, width = size_hw
    rows = np.arange(height)
    samples = np.maximum(1, np.rint(width * np.cos(np.pi * (0.5 - (rows + 0.5) / height)) / stride))
    number = np.floor(np.arange(width) * samples[:, None] / width)
    first = np.diff(number, axis=1, prepend=-1) > 0
    even: NDArray[np.bool_] = first & (rows % stride == stride // 2)[:, None]
    return even
