"""Register new panoramas with cameras whose poses are known and stay fixed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.poses.adjustment.tracks import Tracks, poses_with_points
from pano_mvs.algorithms.poses.growth import add_images
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.placement.reasons import why_no_pair
from pano_mvs.algorithms.poses.placement.resection import refine_resection
from pano_mvs.algorithms.poses.verification.verify_poses import model_of
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Poses, TwoView


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
    pairs = pairs_of(features, two_views)
    model = model_of(known, pairs)
    fixed = frozenset(model.cameras)
    joined = {image for edge in pairs.geometries for image in edge}
    reasons = {
        image: why_no_pair(name, two_views) or "its pairs contradict the pairs around them"
        for image, name in enumerate(pairs.names)
        if image not in joined | fixed
    }
    if fixed:
        reasons |= add_images(model, joined - fixed, adjust=False, confirmation=None)
    tracks = _settled(model, [image for image in model.cameras if image not in fixed])
    poses = Poses.without_points(
        {pairs.names[image]: model.cameras[image] for image in sorted(model.cameras)},
        rejected={pairs.names[image]: reason for image, reason in sorted(reasons.items())},
        frame=known.frame,
        scale=known.scale,
        metric=known.metric,
    )
    return poses_with_points(poses, tracks, max_error_deg=max_error_deg, min_angle_deg=min_angle_deg)


def _settled(model: PlacedModel, new: list[int]) -> Tracks:
    """Refine new cameras and points in turn, while the other cameras stay fixed, and return the tracks."""
    model.choose_again()
    tracks, members = model.tracks()
    for _ in range(3 if new else 0):
        points = model.triangulated(tracks, members).points_in_world[tracks.track_idx]
        known = np.isfinite(points[:, 0])
        for image in new:
            mine = known & (tracks.image_idx == members.index(image))
            model.cameras[image] = refine_resection(
                model.cameras[image], points[mine], tracks.bearings[mine], scale_rad=float(np.deg2rad(0.1))
            )
    return tracks
