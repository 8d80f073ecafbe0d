"""Choose the world frame and the unit of length: first camera and first baseline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Similarity3, similarity_from_points
from pano_mvs.scene import Poses, WorldAxes
from pano_mvs.scene.pose_groups import per_group


def no_poses(rejected: Mapping[str, str]) -> Poses:
    """Return the poses of a capture of which no image is registered, with the reason for each."""
    return Poses.without_points(
        {},
        rejected=rejected,
        frame="the first registered camera",
        scale="none: no image is registered",
        metric=False,
    )


def normalised_poses(poses: Poses) -> Poses:
    """Return the same scene with the first camera as the world and its first baseline as the unit of length.

    The baseline is that to the first other camera, in the capture's order, that does not nearly coincide with the
    first. Each group has its own first camera and first baseline.
    """
    return per_group(poses, _normalised)


def _normalised(poses: Poses) -> Poses:
    if not poses.names:
        return poses
    first = poses.cam_from_world(0)
    neighbour = first_neighbour(poses.centers)
    scale = 1 / _distance(poses.centers, neighbour) if neighbour else 1.0
    moved = moved_poses(poses, Similarity3(scale, first.rotation, scale * first.translation))
    # Exact, without rounding errors.
    moved.rotations[0], moved.translations[0] = np.eye(3), 0.0
    return moved


def in_gauge_of(poses: Poses, centers: FloatArray) -> Poses:
    """Return refined poses in the world frame and unit of length of the (N, 3) centres before the refinement.

    Metric poses keep the frame by the similarity of all centres; others keep the first camera and first baseline. The
    poses are of one group.
    """
    if poses.metric and len(centers) >= 3:
        return moved_back(poses, similarity_from_points(poses.centers, centers))
    neighbour = first_neighbour(centers)
    if not neighbour:
        return poses
    scale = _distance(centers, neighbour) / _distance(poses.centers, neighbour)
    return moved_back(poses, Similarity3(scale, np.eye(3), centers[0] - scale * poses.centers[0]))


def first_neighbour(centers: FloatArray) -> int:
    """Return the position of the camera whose distance to the first is the unit of length; 0 if there is none."""
    distances = np.linalg.norm(centers - centers[0], axis=1)[1:] if len(centers) else np.zeros(0)
    if not distances.any():
        return 0
    # A neighbour closer than this share of the median distance to the first camera gives no reliable unit of length.
    return 1 + int(np.flatnonzero(distances > 0.1 * np.median(distances))[0])


def moved_poses(poses: Poses, new_from_old: Similarity3) -> Poses:
    """Return poses of one group, with their points, in another world frame.

    `axes` become unknown if the world is turned, and `origin_lla` if its origin or its axes change.
    """
    is_turned = not np.allclose(new_from_old.rotation, np.eye(3), rtol=0, atol=1e-12)
    stays = not is_turned and not new_from_old.translation.any()
    cameras = [new_from_old.move_camera(poses.cam_from_world(idx)) for idx in range(len(poses.names))]
    return replace(
        poses,
        rotations=np.array([camera.rotation for camera in cameras]),
        translations=np.array([camera.translation for camera in cameras]),
        points_in_world=new_from_old.apply(poses.points_in_world),
        center_stds=None if poses.center_stds is None else new_from_old.scale * poses.center_stds,
        axes=WorldAxes.UNKNOWN if is_turned else poses.axes,
        origin_lla=poses.origin_lla if stays else None,
    )


def moved_back(poses: Poses, old_from_new: Similarity3) -> Poses:
    """Return poses of one group that left their world, as by an adjustment, back in it: its axes and origin stay."""
    return replace(moved_poses(poses, old_from_new), axes=poses.axes, origin_lla=poses.origin_lla)


def _distance(centers: FloatArray, neighbour: int) -> float:
    return float(np.linalg.norm(centers[neighbour] - centers[0]))
