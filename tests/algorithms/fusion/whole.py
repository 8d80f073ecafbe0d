"""Fuse views that are all in memory, and thin a cloud."""

from __future__ import annotations

from collections.abc import Sequence

from pano_mvs.algorithms.fusion.fuse import VoxelGrid, _points_of, _tie, fuse_stream
from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.fusion.view import FusionView, ViewWindow, confident_view
from pano_mvs.scene import PointCloud


def fuse_views(views: Sequence[FusionView], settings: FusionSettings | None = None, *, threads: int = 1) -> PointCloud:
    """Return the cloud of the points on which views agree."""
    return fuse_stream([view.pose for view in views], views.__getitem__, settings, threads=threads)


def fuse_reference(
    reference: FusionView,
    earlier: Sequence[FusionView],
    later: Sequence[FusionView],
    *,
    settings: FusionSettings | None = None,
) -> PointCloud:
    """Return the points that one view contributes beside earlier and later views; they are not smoothed."""
    chosen = settings or FusionSettings()
    views = [*earlier, *later]
    window = ViewWindow(views.__getitem__, min_confidence=chosen.min_confidence, size=1)
    sources = [(window, idx, _tie(is_earlier=idx < len(earlier))) for idx in range(len(views))]
    return _points_of(confident_view(reference, min_confidence=chosen.min_confidence), sources, chosen, threads=1)


def thin_by_voxels(cloud: PointCloud, voxel_size: float) -> PointCloud:
    """Return a cloud with one point per occupied voxel."""
    grid = VoxelGrid(voxel_size)
    grid.add(cloud)
    return grid.cloud()
