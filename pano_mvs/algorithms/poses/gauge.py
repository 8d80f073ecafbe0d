"""Choose the world frame and the unit of length that the product promises."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, Similarity3, similarity_from_points
from pano_mvs.scene import Poses

# A neighbour nearer than this share of the median distance to the first camera makes no sound unit of length.
_MIN_NEIGHBOUR_SHARE = 0.1


def normalised_poses(poses: Poses) -> Poses:
    """Return the same scene with the first camera as the world and its first baseline as the unit of length.

    The baseline is that to the first other camera, in the capture's order, that does not all but coincide with it.
    """
    if not poses.names:
        return poses
    first = poses.cam_from_world(0)
    return moved_poses(poses, _scaled(first, 1 / first_baseline(poses.centers)))


def first_baseline(centers: NDArray[np.float64]) -> float:
    """Return the length of the first reference–neighbour baseline of cameras at (N, 3) centres; 1 for one camera."""
    distances = np.linalg.norm(centers[1:] - centers[0], axis=1)
    far = distances[distances > _MIN_NEIGHBOUR_SHARE * np.median(distances)] if len(distances) else distances
    return float(far[0]) if len(far) else 1.0


def aligned_poses(poses: Poses, centers: NDArray[np.float64]) -> Poses:
    """Return the same scene moved so that its camera centres come as close as can be to (N, 3) given ones.

    With fewer than three cameras the turn is left as it is.
    """
    if len(centers) < 3:
        scale = first_baseline(centers) / first_baseline(poses.centers)
        return moved_poses(poses, Similarity3(scale, np.eye(3), centers[0] - scale * poses.centers[0]))
    return moved_poses(poses, similarity_from_points(poses.centers, centers))


def moved_poses(poses: Poses, new_from_old: Similarity3) -> Poses:
    """Return poses and points in another world frame."""
    cameras = [new_from_old.move_camera(poses.cam_from_world(idx)) for idx in range(len(poses.names))]
    return Poses(
        names=poses.names,
        rotations=np.array([camera.rotation for camera in cameras]),
        translations=np.array([camera.translation for camera in cameras]),
        points_in_world=new_from_old.apply(poses.points_in_world),
        point_colors_rgb=poses.point_colors_rgb,
        point_errors_rad=poses.point_errors_rad,
        track_point_idx=poses.track_point_idx,
        track_image_idx=poses.track_image_idx,
        track_bearings=poses.track_bearings,
        rejected=poses.rejected,
        frame=poses.frame,
        scale=poses.scale,
        metric=poses.metric,
    )


def _scaled(rigid: Rigid3, scale: float) -> Similarity3:
    return Similarity3(scale, rigid.rotation, scale * rigid.translation)
