"""Fuse range maps into one cloud of points on which views agree, and thin a cloud to one point per voxel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.uncertainty import UNCONFIRMED_UNCERTAINTY
from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.fusion.smooth import smooth_surfaces
from pano_mvs.algorithms.fusion.view import (
    ConfidentView,
    FusionView,
    ViewWindow,
    held_rays,
    nearest_views,
    normals_from_range,
)
from pano_mvs.algorithms.panoramas import columns_per_step
from pano_mvs.algorithms.ranges.agreement import MAX_REPROJECTION_PX, MAX_SURFACE_STEP
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, sines_of_grid
from pano_mvs.scene import PointCloud
from pano_mvs.scene.cloud import joined_uncertainty
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

Grid = tuple[NDArray[np.float64], NDArray[np.float64]]

_SUPPORT_RADIUS = 2


def fuse_stream(
    poses: Sequence[Rigid3],
    load: Callable[[int], FusionView],
    settings: FusionSettings | None = None,
    *,
    threads: int = 1,
    join: Callable[[Iterable[PointCloud]], PointCloud] | None = None,
) -> PointCloud:
    """Fuse views that are loaded one at a time; at most a view and its neighbours are in memory, and the cloud.

    Each view in turn is a reference, with its neighbours as sources. A pixel becomes a point if `min_views` views agree
    on it, by the test of `check_consistency`, unless more views whose own pixel is consistent see through it than
    agree, which means that it is in free space. A pixel that lacks a single view is accepted by the support of its
    surface (`min_support`), unless a consistent pixel contradicts it. Points that another agreeing view sees clearly
    better are left to that view. A point is the mean of the positions in all agreeing views, weighted by 1 / (σ r)²
    (`merge_within`), where σ is the relative uncertainty of the range, or 1; its colour is their mean weighted by
    cos / r², the inverse of the area that a pixel covers; its confidence is the largest of theirs, its uncertainty the
    smallest, because views that confirm each other share their errors.

    The clouds are joined in the order of the views and of their pixels, merged by voxels if `voxel_size` is set, and
    smoothed (`smooth_surfaces`). The result does not depend on what is cached.

    `poses`: cam_from_world of all views. `load`: position of a view to the view; called again if it was dropped from
    the cache. `settings`: settings of the fusion; None: the defaults. `threads`: number of threads; the result does not
    depend on it. `join`: joins the clouds of all views, such as into files; None: `join_clouds`.

    Raises:
        UsageError: if a view's arrays disagree.
    """
    chosen = settings or FusionSettings()
    window = ViewWindow(load, min_confidence=chosen.min_confidence, size=chosen.neighbours + 1)
    grid = None if chosen.voxel_size is None else VoxelGrid(chosen.voxel_size)

    def clouds() -> Iterator[PointCloud]:
        for idx, neighbours in enumerate(nearest_views(poses, chosen.neighbours)):
            sources = [(window, other, _tie(is_earlier=other < idx)) for other in neighbours]
            yield _points_of(window[idx], sources, chosen, threads=threads)

    if grid is None:
        cloud = (join or join_clouds)(clouds())
    else:
        for part in clouds():
            grid.add(part)
        cloud = grid.cloud()
    if not chosen.smooth:
        return cloud
    return smooth_surfaces(cloud, np.array([pose.center for pose in poses]), threads=threads)


def join_clouds(clouds: Iterable[PointCloud]) -> PointCloud:
    """Return one cloud of the points of several, in order; confidences are kept if all clouds have them."""
    clouds, empty = list(clouds), np.zeros((0, 3), np.float32)
    confidences = [cloud.confidence for cloud in clouds if cloud.confidence is not None]
    return PointCloud(
        np.concatenate([empty, *(cloud.points_in_world for cloud in clouds)]),
        np.concatenate([empty, *(cloud.normals_in_world for cloud in clouds)]),
        np.concatenate([empty.astype(np.uint8), *(cloud.colors_rgb for cloud in clouds)]),
        np.concatenate([np.zeros(0, np.uint8), *(cloud.view_counts for cloud in clouds)]),
        np.concatenate([np.zeros(0, np.uint8), *confidences]) if len(confidences) == len(clouds) else None,
        (),
        joined_uncertainty(clouds),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Tallies:
    """Agreement of the sources with each pixel, as computed by `kernels_fuse.add_source`.

    The precisions, 1 / variance in scene units, have the size 0 if they are not known.
    """

    yields: NDArray[np.bool_]
    counts: NDArray[np.uint8]
    violations: NDArray[np.uint8]
    confidence: NDArray[np.uint8]
    sums: NDArray[np.float64]
    colors: NDArray[np.float64]
    precisions: NDArray[np.float64]

    def deviations(self) -> NDArray[np.float32]:
        """Return the standard deviation of each merged point in scene units, (H, W): that of its best view."""
        return np.asarray(1 / np.sqrt(self.precisions), np.float32)

    def arrays(self) -> tuple[NDArray[np.generic], ...]:
        """Return all arrays in the kernel's order."""
        return self.yields, self.counts, self.violations, self.confidence, self.sums, self.colors, self.precisions


def _points_of(
    reference: ConfidentView,
    sources: Sequence[tuple[ViewWindow, int, float]],
    settings: FusionSettings,
    *,
    threads: int,
) -> PointCloud:
    """Return the points of one view; sources are (window of views, position in it, `_tie`)."""
    height, width = reference.ranges.shape
    rays = held_rays((height, width))
    written = _chosen_pixels((height, width), settings)
    normals = normals_from_range(reference.ranges, given=reference.normals, wanted=written, threads=threads)
    unknown = ~np.isfinite(normals[..., 0])
    normals[unknown] = -rays[unknown]  # towards the camera
    tallies, grid = _own_tallies(reference, rays, normals), sines_of_grid((height, width))
    for window, idx, tie in sources:
        _compare_with(
            window[idx], tie, (reference, grid, normals, written), settings=settings, tallies=tallies, threads=threads
        )
    kept = _kept(reference, tallies, settings) & written
    position = tallies.sums[kept]
    color = tallies.colors[kept]
    world_from_cam = reference.pose.inverse()
    return PointCloud(
        points_in_world=world_from_cam.apply(position[:, :3] / position[:, 3:]).astype(np.float32),
        normals_in_world=(normals[kept].astype(np.float64) @ world_from_cam.rotation.T).astype(np.float32),
        colors_rgb=np.rint(color[:, :3] / color[:, 3:]).clip(0, 255).astype(np.uint8),
        view_counts=tallies.counts[kept],
        confidence=tallies.confidence[kept],
        uncertainty=None if reference.uncertainty is None else tallies.deviations()[kept],
    )


def _own_tallies(reference: ConfidentView, rays: NDArray[np.float64], normals: NDArray[np.float32]) -> _Tallies:
    """Return tallies with only the reference's own pixels."""
    shape = reference.ranges.shape
    ranges = reference.ranges.astype(np.float64)
    sigma = reference.uncertainty
    weight = 1 / ranges**2
    # As in the kernel: a pixel's footprint is r² / cosine.
    color_weight = weight * (-np.einsum("hwc,hwc->hw", rays, normals, dtype=np.float64)).clip(0.05)
    precision = weight if sigma is None else weight / sigma.astype(np.float64) ** 2
    return _Tallies(
        yields=np.zeros(shape, np.bool_),
        counts=np.isfinite(ranges).astype(np.uint8),
        violations=np.zeros(shape, np.uint8),
        confidence=reference.confidence.copy(),
        sums=np.concatenate([rays * (precision * ranges)[..., None], precision[..., None]], axis=-1),
        colors=np.concatenate([reference.image * color_weight[..., None], color_weight[..., None]], axis=-1),
        precisions=np.zeros((0, 0)) if sigma is None else precision.copy(),
    )


def _compare_with(
    source: ConfidentView,
    tie: float,
    pixels: tuple[ConfidentView, Grid, NDArray[np.float32], NDArray[np.bool_]],
    *,
    settings: FusionSettings,
    tallies: _Tallies,
    threads: int,
) -> None:
    from pano_mvs.algorithms.fusion.kernels_fuse import add_source  # compiles on import

    reference, *arrays_of_pixels = pixels
    height, width = reference.ranges.shape
    max_angle = MAX_REPROJECTION_PX * 2 * np.pi / width
    limits = np.array(
        [
            settings.max_relative_error,
            max_angle,
            MAX_SURFACE_STEP,
            settings.max_footprint_ratio * tie,
            settings.merge_within,
            CONSISTENT_CONFIDENCE[0],
        ]
    )
    source_from_reference = source.pose @ reference.pose.inverse()
    relation = (
        np.ascontiguousarray(source_from_reference.rotation),
        np.ascontiguousarray(source_from_reference.translation),
    )
    arrays = (*relation, source.ranges, source.confidence, source.image, _uncertainty_of(source, reference))

    def of_rows(first: int, rows: int) -> None:
        add_source((reference.ranges, *arrays_of_pixels), arrays, limits, (first, first + rows), tallies.arrays())

    for_bands(of_rows, height, threads=threads)


def _uncertainty_of(source: ConfidentView, reference: ConfidentView) -> NDArray[np.float32]:
    """Return a source's relative uncertainty; of size 0 if the reference's is not known."""
    if reference.uncertainty is None:
        return np.zeros((0, 0), np.float32)
    if source.uncertainty is None:
        return np.full(source.ranges.shape, UNCONFIRMED_UNCERTAINTY, np.float32)
    return source.uncertainty


def _kept(reference: ConfidentView, tallies: _Tallies, settings: FusionSettings) -> NDArray[np.bool_]:
    """Return the pixels, (H, W), that become points."""
    from pano_mvs.algorithms.fusion.kernels_fuse import find_supported  # compiles on import

    shape = reference.ranges.shape
    seen = np.isfinite(reference.ranges)
    agreeing = tallies.counts.astype(np.int64)
    confirmed = seen & (agreeing >= settings.min_views) & (tallies.violations <= agreeing - 1)
    kept = confirmed
    if settings.min_support is not None and settings.min_views > 1:
        stretches = columns_per_step((shape[0], shape[1]), steps=2 * _SUPPORT_RADIUS + 1)
        supported = find_supported(reference.ranges, confirmed, stretches, _SUPPORT_RADIUS, 0.03, settings.min_support)
        kept = confirmed | (supported & (agreeing == settings.min_views - 1) & (tallies.violations == 0))
    if settings.max_uncertainty is not None and reference.uncertainty is not None:
        kept = kept & (tallies.deviations() <= settings.max_uncertainty * reference.ranges)
    return kept & ~tallies.yields


def _tie(*, is_earlier: bool) -> float:
    """Return the factor on the largest footprint ratio that breaks ties with an earlier or a later source."""
    # If two views see a surface about equally well, the earlier one contributes it: it may be 5 % worse, and the later
    # one must be 3 % better. Points between these limits are written twice, so that small errors of the footprints
    # leave no gap.
    return 0.97 if is_earlier else 1.05


def _chosen_pixels(size_hw: tuple[int, int], settings: FusionSettings) -> NDArray[np.bool_]:
    """Return every stride-th pixel, (H, W); for even density, a row at elevation φ has the share cos φ of them."""
    height, width = size_hw
    rows = np.arange(height)
    share = np.cos(np.pi * (0.5 - (rows + 0.5) / height)) if settings.even_density else np.ones(height)
    samples = np.maximum(1, np.rint(width * share / settings.stride))
    number = np.floor(np.arange(width) * samples[:, None] / width)
    first = np.diff(number, axis=1, prepend=-1) > 0
    chosen: NDArray[np.bool_] = first & (rows % settings.stride == settings.stride // 2)[:, None]
    return chosen


# Number of points that are collected before they are sorted into voxels; with fewer, voxels are sorted too often.
_MIN_WAITING = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class _Voxels:
    """Voxels in the order in which they first appeared.

    `places`: (G, 3) int64. `sums`: (G, 10) of weights, and of weighted positions, normals and colours. `first_normals`:
    (G, 3) float32. `largest`: (G, 2) uint8 number of views and confidence. `uncertainties`: (G,) float32, the smallest
    of each voxel.
    """

    places: NDArray[np.int64]
    sums: NDArray[np.float64]
    first_normals: NDArray[np.float32]
    largest: NDArray[np.uint8]
    uncertainties: NDArray[np.float32]


class VoxelGrid:
    """Adds clouds one at a time, and keeps one point per occupied voxel; memory grows with the number of voxels.

    The points are in the order in which voxels first appear. Positions and colours are averages over the voxel,
    weighted by the number of views; normals are averaged and normalised, or the first one if they cancel; the numbers
    of views and the confidences are maxima, the uncertainties minima. Voxels are aligned with the world's axes and its
    origin.
    """

    def __init__(self, voxel_size: float) -> None:
        """Create an empty grid.

        Raises:
            UsageError: if the voxel size is not positive.
        """
        if not voxel_size > 0:
            raise UsageError(f"voxel_size must be positive, got {voxel_size}")
        self._voxel_size = voxel_size
        self._parts: list[_Voxels] = []
        self._has_confidence = True
        self._has_uncertainty = True

    def add(self, cloud: PointCloud) -> None:
        """Add the points of a cloud."""
        weight = np.maximum(cloud.view_counts, 1).astype(np.float64)[:, None]
        places = np.floor(cloud.points_in_world.astype(np.float64) / self._voxel_size).astype(np.int64)
        values = np.concatenate([cloud.points_in_world, cloud.normals_in_world, cloud.colors_rgb], axis=1, dtype=float)
        confidence = np.zeros_like(cloud.view_counts) if cloud.confidence is None else cloud.confidence
        largest = np.stack([cloud.view_counts, confidence], axis=1)
        uncertainty = np.zeros(len(cloud), np.float32) if cloud.uncertainty is None else cloud.uncertainty
        self._has_confidence &= cloud.confidence is not None
        self._has_uncertainty &= cloud.uncertainty is not None
        sums = np.concatenate([weight, weight * values], axis=1)
        self._parts.append(_merged([_Voxels(places, sums, cloud.normals_in_world, largest, uncertainty)]))
        waiting = sum(len(part.places) for part in self._parts[1:])
        if waiting > max(_MIN_WAITING, len(self._parts[0].places)):
            self._parts = [_merged(self._parts)]

    def cloud(self) -> PointCloud:
        """Return the points of all voxels."""
        empty = np.zeros((0, 3), np.float32)
        none = _Voxels(empty.astype(np.int64), np.zeros((0, 10)), empty, np.zeros((0, 2), np.uint8), empty[:, 0])
        voxels = self._parts[0] if len(self._parts) == 1 else _merged([none, *self._parts])
        mean = voxels.sums[:, 1:] / voxels.sums[:, :1]
        length = np.linalg.norm(mean[:, 3:6], axis=1, keepdims=True)
        normals = np.where(length > 0.1, mean[:, 3:6] / np.maximum(length, 0.1), voxels.first_normals)
        return PointCloud(
            points_in_world=mean[:, :3].astype(np.float32),
            normals_in_world=normals.astype(np.float32),
            colors_rgb=np.rint(mean[:, 6:]).astype(np.uint8),
            view_counts=voxels.largest[:, 0].copy(),
            confidence=voxels.largest[:, 1].copy() if self._has_confidence else None,
            uncertainty=voxels.uncertainties.copy() if self._has_uncertainty else None,
        )


def _merged(parts: list[_Voxels]) -> _Voxels:
    """Return the voxels of all parts without duplicates."""
    places = np.concatenate([part.places for part in parts])
    order = np.lexsort(places.T[::-1])  # stable: the first point of a voxel stays in front
    begins = np.ones(len(order), np.bool_)
    begins[1:] = (np.diff(places[order], axis=0) != 0).any(axis=1)
    starts = np.flatnonzero(begins)
    if not len(starts):
        return parts[0]
    first = order[starts]
    appearance = np.argsort(first, kind="stable")
    sums = np.concatenate([part.sums for part in parts])[order]
    largest = np.concatenate([part.largest for part in parts])[order]
    uncertainties = np.concatenate([part.uncertainties for part in parts])[order]
    return _Voxels(
        places[first[appearance]],
        np.add.reduceat(sums, starts, axis=0)[appearance],
        np.concatenate([part.first_normals for part in parts])[first[appearance]],
        np.maximum.reduceat(largest, starts, axis=0)[appearance],
        np.minimum.reduceat(uncertainties, starts)[appearance],
    )
