"""Register new panoramas with cameras whose poses are known and stay fixed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.poses.adjustment.tracks import build_tracks, poses_with_points
from pano_mvs.algorithms.poses.placement.growing_model import GrowingModel
from pano_mvs.algorithms.poses.placement.resection import refine_resection, why_no_pair
from pano_mvs.algorithms.poses.placement.view_graph import consistent_edges
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Poses, TwoView

_ROUNDS = 3


@checks_settings
def extend_poses(
    known: Poses,
    features: Mapping[str, Features],
    two_views: Mapping[tuple[str, str], TwoView],
    *,
    max_error_deg: Annotated[float, Setting("observations with a larger error are dropped", gt=0)] = 0.4,
    min_angle_deg: Annotated[float, Setting("minimum angle between the rays of a point", gt=0)] = 1.0,
) -> Poses:
    """Register new images with known cameras; the known poses stay exactly as they are.

    Tracks are triangulated from the known cameras. Each new image is placed by its pairs with registered images, and
    its pose is refined by resection against the points (angular, robust). When all images are placed, points are
    triangulated again from old and new cameras, and the new cameras are refined against them, a few times.

    Args:
        known: poses by the names in `features`; others are ignored. The points of these poses are replaced.
        features: key points by image name, in the capture's order.
        two_views: verified pairs.

    Returns:
        Poses of all registered images in the capture's order, in the frame and unit of the known poses. Images that
        cannot be registered are in `rejected`, with the reason.
    """
    names = tuple(features)
    edges = consistent_edges(names, two_views)
    kept = {(names[a], names[b]): view for (a, b), view in edges.items()}
    tracks = build_tracks(features, kept)
    model = GrowingModel(tracks, edges, "cauchy", kappa=0.01)
    position = {name: idx for idx, name in enumerate(names)}
    fixed = {position[name]: known.cam_from_world(i) for i, name in enumerate(known.names) if name in position}
    model.cameras.update(fixed)
    model.triangulate()
    reasons = {position[name]: reason for name in names if (reason := why_no_pair(name, two_views))}
    joined = {idx for edge in edges for idx in edge}
    for idx in range(len(names)):
        if idx not in joined:
            reasons.setdefault(idx, "its pairs contradict the pairs around them")
    reasons |= model.attach_all(sorted(joined - fixed.keys()))
    _settled(model, [idx for idx in model.cameras if idx not in fixed])
    poses = Poses.without_points(
        {names[idx]: model.cameras[idx] for idx in sorted(model.cameras)},
        rejected={names[idx]: reason for idx, reason in sorted(reasons.items()) if idx not in fixed},
        frame=known.frame,
        scale=known.scale,
        metric=known.metric,
    )
    return poses_with_points(poses, tracks, max_error_deg=max_error_deg, min_angle_deg=min_angle_deg)


def _settled(model: GrowingModel, new: list[int]) -> None:
    """Refine new cameras and points in turn; the other cameras stay fixed."""
    for _ in range(_ROUNDS if new else 0):
        model.triangulate()
        for image in new:
            points, bearings = model.known_points(image)
            model.cameras[image] = refine_resection(
                model.cameras[image], points, bearings, scale_rad=float(np.deg2rad(0.1))
            )
