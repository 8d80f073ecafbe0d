"""Everything that is said of estimated poses against true ones, as plain numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.metrics.poses import CenterErrors, PoseErrors, center_errors, relative_pose_errors
from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3


@dataclass(frozen=True, eq=False)
class PoseReport:
    """Errors of poses against the truth.

    Attributes:
        pairs: over all pairs of the truth's images; a pair with an image that is not registered is 180° off.
        registered_pairs: over the pairs of registered images alone.
        centers: after similarity alignment, or None where that is impossible.
        no_centers: why it is; else empty.
    """

    pairs: PoseErrors
    registered_pairs: PoseErrors
    centers: CenterErrors | None
    no_centers: str = ""

    def to_json(self) -> dict[str, object]:
        """Return all figures as JSON values; None stands for what could not be told. Lengths: the truth's unit."""
        some, all_pairs = self.registered_pairs, self.pairs
        return {
            "registered": all_pairs.registered,
            "of": all_pairs.expected,
            "pairs": len(all_pairs.pairs),
            "rotation_deg": summary(some.rotation_deg),
            "direction_deg": summary(some.direction_deg),
            "pair_deg": summary(some.pair_deg),
            "pair_deg_all": summary(all_pairs.pair_deg),
            "auc": {f"{limit:g}": value for limit, value in all_pairs.auc.items()},
            "scale_ratio_error": {
                "median": _finite(some.scale_ratio_median),
                "max": _finite(some.scale_ratio_max),
            },
            "center": self._centers_json(),
        }

    def _centers_json(self) -> dict[str, object]:
        if self.centers is None:
            return {"reason": self.no_centers}
        lengths = self.centers.distances
        return {
            **summary(lengths),
            "rms": float(np.sqrt(np.mean(lengths**2))),
            "extent": self.centers.extent,
            "median_share_of_extent": float(np.median(lengths)) / self.centers.extent,
            "max_share_of_extent": float(lengths.max()) / self.centers.extent,
            "scale": self.centers.scale,
            "images": dict(zip(self.centers.names, lengths.tolist(), strict=True)),
        }


def report_poses(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> PoseReport:
    """Return all that can be said of estimated poses against true ones.

    Args:
        estimated: cam_from_world by image name, in any world frame and unit.
        truth: true cam_from_world by image name.

    Raises:
        UsageError: if fewer than two images have both.
    """
    common = {name: pose for name, pose in truth.items() if name in estimated}
    if len(common) < 2:
        raise UsageError(
            f"only {len(common)} {plural(len(common), 'image has', 'images have')} both an estimate and truth; "
            "relative poses need two"
        )
    pairs, registered_pairs = relative_pose_errors(estimated, truth), relative_pose_errors(estimated, common)
    try:
        return PoseReport(pairs, registered_pairs, center_errors(estimated, truth))
    except UsageError as error:
        return PoseReport(pairs, registered_pairs, None, str(error))


def summary(values: NDArray[np.float64]) -> dict[str, float]:
    """Return median, mean and largest of some errors."""
    return {"median": float(np.median(values)), "mean": float(values.mean()), "max": float(values.max())}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
