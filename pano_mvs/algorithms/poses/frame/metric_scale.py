"""Scale poses to metres by a known length, or set the distance of each camera to the first to 1."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pano_mvs.algorithms.points.floor import Floor, floor_below
from pano_mvs.algorithms.poses.frame.gauge import moved_poses
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import per_group


def scaled_poses(poses: Poses, factor: float, *, origin: str) -> Poses:
    """Return the same scene with all lengths multiplied by a factor, in metres.

    Angles, including the errors of points, do not change.

    Args:
        poses: in any unit.
        factor: metres per unit of the poses.
        origin: description of where the factor comes from.

    Raises:
        UsageError: if the factor is not positive.
    """
    if not (np.isfinite(factor) and factor > 0):
        raise UsageError(f"a scale must be a positive number, got {factor}")
    scaled = moved_poses(poses, Similarity3(factor, np.eye(3), np.zeros(3)))
    return replace(scaled, scale=f"metres, by {origin}", metric=True)


def scaled_by_baseline(poses: Poses, first: str, second: str, *, metres: float) -> Poses:
    """Return the same scene in metres, given the distance between two cameras.

    Args:
        poses: in any unit.
        first: name of a registered image.
        second: name of another registered image.
        metres: distance between their centres.

    Raises:
        UsageError: if an image is not registered, or both are at the same place.
    """
    for name in (first, second):
        if name not in poses.names:
            why = poses.rejected.get(name, "no such image")
            raise UsageError(
                f"the baseline's image {name} is not registered ({why}). Use two registered images, such as: "
                f"{', '.join(poses.names[:8])}"
            )
    centers = poses.centers
    distance = float(np.linalg.norm(centers[poses.names.index(second)] - centers[poses.names.index(first)]))
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    # Cameras closer than this share of the capture's extent are at the same place: their distance is noise.
    if distance <= 1e-3 * extent:
        raise UsageError(
            f"{first} and {second} were taken in one place, so the distance between them gives no scale. "
            "Use two images that are farther apart"
        )
    return scaled_poses(poses, metres / distance, origin=f"the baseline of {metres:g} m from {first} to {second}")


def scaled_by_camera_height(poses: Poses, up_in_world: FloatArray, *, metres: float) -> tuple[Poses, Floor]:
    """Return the same scene in metres, given the height of the cameras above the floor.

    Args:
        poses: in any unit, with sparse points.
        up_in_world: (3,) unit vector away from gravity.
        metres: median height of the cameras above the floor.

    Returns:
        The poses and the floor that was found. If there is none, the unchanged poses and a falsy floor with the reason.
    """
    floor = floor_below(poses.points_in_world, poses.centers, up_in_world)
    if not floor:
        return poses, floor
    origin = f"the cameras' height of {metres:g} m above a floor of {floor.points} sparse points"
    return scaled_poses(poses, metres / floor.depth, origin=origin), floor


def unit_translations(poses: Poses) -> Poses:
    """Return poses in which every camera is at distance 1 from the first camera, in its original direction.

    This is all that the essential matrices of the pairs with the first image determine (Yang, Kim & Lee, "Dense Depth
    Estimation from Multiple 360-degree Images Using Virtual Depth", section 3.2: the scale factors of all views are set
    to 1). Sparse points do not fit such cameras and are removed. A camera that coincides with the first camera stays
    there. Each group has its own first camera.
    """
    return per_group(poses, _unit_translations)


def _unit_translations(poses: Poses) -> Poses:
    centers = poses.centers
    moved: dict[str, Rigid3] = {}
    for idx, name in enumerate(poses.names):
        offset = centers[idx] - centers[0]
        length = float(np.linalg.norm(offset))
        center = centers[0] + (offset / length if length > 0 else offset)
        moved[name] = Rigid3.from_center(poses.rotations[idx], center)
    return Poses.without_points(
        moved,
        rejected=poses.rejected,
        **poses.worlds[0]
        ._replace(scale="every camera is at distance 1 from the first: no scale factors", metric=False)
        ._asdict(),
    )
