"""Whether confidence knows where the errors are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.ranges.pixels import has_range
from pano_mvs.geometry import pixel_solid_angle

# A range that is wrong by more than itself is simply wrong; without a limit a few pixels at the far end decide alone.
_LARGEST_ERROR = 1.0


@dataclass(frozen=True, eq=False)
class Sparsification:
    """The mean error of the surest pixels against the share of the pixels that is kept.

    Pixels of the same confidence are kept or left out together; between two confidences the curve is that of a random
    order. Errors are |error| / truth, at most 1; pixels count by their solid angle, or all
    alike.

    Attributes:
        kept: (N,) float64 share of all pixels with truth and estimate that is kept, growing to 1.
        error: (N,) float64 mean relative error of those.
        oracle_error: (N,) float64 the same if the pixels were ordered by their true errors.
        area: under the curve: the mean over all shares.
        oracle_area: under the oracle's.
    """

    kept: NDArray[np.float64]
    error: NDArray[np.float64]
    oracle_error: NDArray[np.float64]
    area: float
    oracle_area: float

    @property
    def ause(self) -> float:
        """The area between the two curves: 0 if confidence orders the pixels like their errors; less is better."""
        return self.area - self.oracle_area

    @property
    def unranked_area(self) -> float:
        """The area if all pixels were of one confidence: the mean error."""
        return float(self.error[-1]) if len(self.error) else float("nan")


def sparsify(
    estimated: NDArray[np.floating],
    confidence: NDArray[np.integer],
    truth: NDArray[np.floating],
    *,
    scale: float = 1.0,
    by_solid_angle: bool = True,
) -> Sparsification:
    """Return the sparsification curve of a range map, NaN areas and an empty curve if no pixel can be judged.

    E. Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical flow", ECCV 2018, section 5.1.

    Args:
        estimated: (H, W) ranges in scene units, NaN invalid.
        confidence: (H, W), larger is surer.
        truth: (H, W) true ranges; infinite or NaN where there is no surface.
        scale: factor from scene units to the truth's unit.
        by_solid_angle: whether pixels count by their solid angle; else all alike.

    Raises:
        UsageError: if the shapes differ or the scale is not positive.
    """
    if not estimated.shape == confidence.shape == truth.shape or truth.ndim != 2 or not scale > 0:
        raise UsageError(f"estimated {estimated.shape}, confidence {confidence.shape} and truth {truth.shape} must be "
                         f"(H, W) of one size, and the scale {scale} positive")  # fmt: skip
    judged = has_range(truth) & has_range(estimated)
    weight = np.broadcast_to(pixel_solid_angle((truth.shape[0], truth.shape[1]))[:, None], truth.shape)[judged]
    if not by_solid_angle:
        weight = np.ones_like(weight)
    if len(weight) == 0:
        nothing = np.zeros(0)
        return Sparsification(nothing, nothing, nothing, float("nan"), float("nan"))
    true = truth[judged].astype(np.float64)
    error = np.minimum(np.abs(scale * estimated[judged] - true) / true, _LARGEST_ERROR)
    kept, mean, area = _curve(confidence[judged].astype(np.float64), error, weight)
    oracle_kept, oracle_mean, oracle_area = _curve(-error, error, weight)
    return Sparsification(kept, mean, np.interp(kept, oracle_kept, oracle_mean), area, oracle_area)


def _curve(
    sureness: NDArray[np.float64], error: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the shares kept, the mean errors of them, and the area under the curve."""
    levels, level = np.unique(-sureness, return_inverse=True)
    added = np.bincount(level, weight, len(levels)) / weight.sum()
    lost = np.bincount(level, weight * error, len(levels)) / weight.sum()
    kept, total = np.cumsum(added), np.cumsum(lost)
    before, total_before = kept - added, total - lost
    # Within a level of mean error m the curve is (E + m x) / (k + x), whose integral over x from 0 to a is
    # m a + (E − m k) ln(1 + a / k).
    mean = lost / added
    growth = np.log1p(np.divide(added, before, out=np.zeros_like(added), where=before > 0))
    area = float(np.sum(mean * added + (total_before - mean * before) * growth))
    return kept, total / kept, area
