"""How good camera poses are, against ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, Similarity3, angle_between, geodesic_angle, similarity_from_points

FloatArray = NDArray[np.float64]

AUC_LIMITS_DEG = (0.1, 0.5, 1.0, 5.0)
_COINCIDENT = 1e-9


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of relative poses, over all pairs of the images that have truth.

    Attributes:
        pairs: (P) the pairs of image names.
        rotation_deg: (P,) error of second_from_first's rotation; 180 where an image is not registered.
        direction_deg: (P,) error of the direction of its translation; 180 likewise.
        pair_deg: (P,) the larger of the two.
        median_pair_deg: median of `pair_deg`.
        auc: limit in degrees to the area under the recall curve of `pair_deg` up to it, in [0, 1].
        registered: number of images that have an estimate.
        expected: number of images that have truth.
        scale_ratio_median: median of |baseline ratio − 1| after division by the median ratio; NaN below 3 images.
        scale_ratio_max: largest of them.
    """

    pairs: tuple[tuple[str, str], ...]
    rotation_deg: FloatArray
    direction_deg: FloatArray
    pair_deg: FloatArray
    median_pair_deg: float
    auc: dict[float, float]
    registered: int
    expected: int
    scale_ratio_median: float
    scale_ratio_max: float


def relative_pose_errors(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> PoseErrors:
    """Return the errors of all pairs of the truth's images; they depend on no choice of world frame or scale.

    Args:
        estimated: cam_from_world by image name; names without truth are left out.
        truth: true cam_from_world by image name, two at least.

    Raises:
        UsageError: if the truth holds fewer than two images.
    """
    if len(truth) < 2:
        raise UsageError(f"relative poses need the truth of at least two images, got {len(truth)}")
    pairs = tuple(combinations(truth, 2))
    errors = np.array([_pair_error_deg(first, second, estimated, truth) for first, second in pairs])
    pair_deg = errors.max(axis=1)
    ratios = _baseline_ratios(estimated, truth)
    deviations = np.abs(ratios / np.median(ratios) - 1) if len(ratios) > 1 else np.array([np.nan])
    return PoseErrors(
        pairs=pairs,
        rotation_deg=errors[:, 0],
        direction_deg=errors[:, 1],
        pair_deg=pair_deg,
        median_pair_deg=float(np.median(pair_deg)),
        auc={limit: float(np.clip(1 - pair_deg / limit, 0, 1).mean()) for limit in AUC_LIMITS_DEG},
        registered=sum(name in estimated for name in truth),
        expected=len(truth),
        scale_ratio_median=float(np.median(deviations)),
        scale_ratio_max=float(deviations.max()),
    )


def align_centers(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> Similarity3:
    """Return the similarity world_truth from world_estimated that brings the camera centres together.

    Args:
        estimated: cam_from_world by image name.
        truth: true cam_from_world by image name; three common names that are not in a line determine it.

    Raises:
        UsageError: if fewer than two images are common, or the estimated centres coincide.
    """
    names = [name for name in truth if name in estimated]
    if len(names) < 2:
        raise UsageError(f"only {len(names)} images have both an estimate and truth; two are needed for a scale")
    return similarity_from_points([estimated[n].center for n in names], [truth[n].center for n in names])


def _pair_error_deg(
    first: str, second: str, estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]
) -> tuple[float, float]:
    """Return the errors of rotation and of direction; a pair truly taken from one place has no direction."""
    if first not in estimated or second not in estimated:
        return 180.0, 180.0
    guess = estimated[second] @ estimated[first].inverse()
    true = truth[second] @ truth[first].inverse()
    rotation_deg = float(np.rad2deg(geodesic_angle(guess.rotation, true.rotation)))
    if np.linalg.norm(true.translation) < _COINCIDENT:
        return rotation_deg, 0.0
    if np.linalg.norm(guess.translation) < _COINCIDENT:
        return rotation_deg, 180.0
    return rotation_deg, float(np.rad2deg(angle_between(guess.translation, true.translation)))


def _baseline_ratios(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> FloatArray:
    """Return estimated over true baseline length of every pair that has both."""
    names = [name for name in truth if name in estimated]
    true = {name: truth[name].center for name in names}
    guess = {name: estimated[name].center for name in names}
    lengths = [
        (np.linalg.norm(guess[b] - guess[a]), np.linalg.norm(true[b] - true[a])) for a, b in combinations(names, 2)
    ]
    return np.array([g / t for g, t in lengths if t > _COINCIDENT and g > _COINCIDENT])
