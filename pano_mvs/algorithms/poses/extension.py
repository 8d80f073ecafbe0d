"""Register new panoramas against cameras that are known already and do not move."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pano_mvs.algorithms.poses.adjustment.tracks import build_tracks, poses_with_points
from pano_mvs.algorithms.poses.placement.reasons import why_no_pair
from pano_mvs.algorithms.poses.placement.registration import GrowingModel
from pano_mvs.algorithms.poses.placement.resection import refine_resection
from pano_mvs.algorithms.poses.placement.view_graph import consistent_edges
from pano_mvs.scene import Features, Poses, TwoView

_ROUNDS = 3
_RESECTION_SCALE_RAD = float(np.deg2rad(0.1))


def extend_poses(
    known: Poses,
    features: Mapping[str, Features],
    two_views: Mapping[tuple[str, str], TwoView],
    *,
    max_error_deg: float = 0.4,
    min_angle_deg: float = 1.0,
) -> Poses:
    """Return known poses, not moved by a digit, with those of new images that see their points.

    The tracks of the known cameras are triangulated; every new image is attached by its pairs with registered ones,
    and its pose refined by resection against the points (angular, robust). When all are attached the points are
    triangulated again from old and new cameras, and the new ones refined against them, a few times.

    Args:
        known: poses by the names of `features`; others are left out. Its points are replaced.
        features: key points by image name, in the capture's order.
        two_views: verified pairs.
        max_error_deg: observations further off than this give no point.
        min_angle_deg: smallest angle between the rays of a point seen twice.

    Returns:
        The images in the capture's order, in the frame and unit of the known ones; what cannot be attached is in
        `rejected`, with the reason.
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
    """Refine new cameras and points in turn; the other cameras stay."""
    for _ in range(_ROUNDS if new else 0):
        model.triangulate()
        for image in new:
            points, bearings = model.known_points(image)
            model.cameras[image] = refine_resection(
                model.cameras[image], points, bearings, scale_rad=_RESECTION_SCALE_RAD
            )
