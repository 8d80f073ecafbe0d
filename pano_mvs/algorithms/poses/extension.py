"""Register new panoramas with cameras whose poses are known and stay fixed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.poses.adjustment.tracks import poses_with_points
from pano_mvs.algorithms.poses.growth import extend, why_nothing
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.placement.resection import MAX_ERROR_RAD, MIN_POINTS, refine_resection, why_no_pair
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
    names = tuple(features)
    pairs = pairs_of(features, two_views)
    model = PlacedModel(pairs, {names.index(name): pose for name, pose in known.cameras.items() if name in features})
    fixed = {*model.cameras}
    model.verify_again()
    left = {*range(len(names))} - fixed
    reasons = extend(model, left, adjust=False) if fixed else {}
    poses = Poses.without_points(
        {names[idx]: model.cameras[idx] for idx in sorted(model.cameras)},
        rejected={
            names[idx]: why_no_pair(names[idx], two_views) or reasons.get(idx) or why_nothing(model, idx)
            for idx in sorted(left)
        },
        **known.worlds[0]._asdict(),
    )
    tracks, members = model.tracks()
    for _ in range(3):
        # Points by the limits of placement, whatever is kept of them in the end.
        seen = poses_with_points(poses, tracks, max_error_deg=float(np.rad2deg(MAX_ERROR_RAD)), min_angle_deg=1.0)
        for position, image in enumerate(members):
            own = seen.track_image_idx == position
            if image not in fixed and own.sum() >= MIN_POINTS:
                points, bearings = seen.points_in_world[seen.track_point_idx[own]], seen.track_bearings[own]
                pose = refine_resection(
                    poses.cam_from_world(position), points, bearings, scale_rad=float(np.deg2rad(0.1))
                )
                poses.rotations[position], poses.translations[position] = pose.rotation, pose.translation
    return poses_with_points(poses, tracks, max_error_deg=max_error_deg, min_angle_deg=min_angle_deg)
