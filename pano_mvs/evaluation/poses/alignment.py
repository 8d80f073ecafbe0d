"""Alignment of camera poses to the true ones."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3, Similarity3, nearest_rotation

# Weight of the cameras' orientations against the spread of their centres. Enough to fix the turn about a line on which
# all centres lie; negligible elsewhere.
_ORIENTATION_SHARE = 1e-6


def align_centers(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> Similarity3:
    """Return the similarity world_truth from world_estimated that best aligns the camera centres.

    Umeyama 1991, with the cameras' orientations added to the covariance at a weight that matters only where the
    centres leave a rotation open: two images, images on a line, an image that occurs twice.

    Args:
        estimated: cam_from_world by image name.
        truth: true cam_from_world by image name; at least two common names, at different places.

    Raises:
        UsageError: if fewer than two images are common, or their centres coincide on either side.

    Example:
        >>> import numpy as np
        >>> from pano_mvs.geometry import Rigid3
        >>> truth = {name: Rigid3(np.eye(3), np.array([x, 0.0, 0.0])) for name, x in (("a", 0.0), ("b", 2.0))}
        >>> half = {name: Rigid3(pose.rotation, pose.translation / 2) for name, pose in truth.items()}
        >>> round(align_centers(half, truth).scale, 6)
        2.0
    """
    names = [name for name in truth if name in estimated]
    if len(names) < 2:
        have = plural(len(names), "image has", "images have")
        raise UsageError(f"only {len(names)} {have} both an estimate and truth; two are needed for a scale")
    source = np.array([estimated[name].center for name in names])
    target = np.array([truth[name].center for name in names])
    middle, aim = source.mean(axis=0), target.mean(axis=0)
    spread, true_spread = float(np.linalg.norm(source - middle)), float(np.linalg.norm(target - aim))
    for what, length, centers in (("estimated", spread, source), ("true", true_spread, target)):
        if length <= 1e-12 * max(1.0, float(np.abs(centers).max())):
            raise UsageError(f"the {what} centres of all {len(names)} images coincide, so no scale can be estimated")
    covariance = (target - aim).T @ (source - middle) / (spread * true_spread)
    turns = [truth[name].rotation.T @ estimated[name].rotation for name in names]
    rotation = nearest_rotation(covariance + _ORIENTATION_SHARE * np.mean(turns, axis=0))
    scale = float(np.trace(rotation.T @ covariance)) * true_spread / spread
    return Similarity3(scale, rotation, aim - scale * rotation @ middle)


def camera_extent(poses: Mapping[str, Rigid3]) -> float:
    """Return the largest distance between two camera centres; 0 with fewer than two."""
    centers = np.array([pose.center for pose in poses.values()]).reshape(-1, 3)
    return max((float(np.linalg.norm(centers - center, axis=1).max()) for center in centers), default=0.0)
