"""Poses without translation scale factors, for the paper's ablation."""

from __future__ import annotations

import numpy as np

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import per_group


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
        frame=poses.frame,
        scale="every camera is at distance 1 from the first: no scale factors",
        metric=False,
    )
