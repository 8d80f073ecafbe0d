"""Sparsification: how well confidence predicts the errors of a range map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.ranges.pixels import ScoredPixels

# Larger relative errors count as this one; otherwise a few far pixels would decide the area.
_MAX_ERROR = 1.0


@dataclass(frozen=True, eq=False)
class Sparsification:
    """Mean error of the most confident pixels against the share of pixels that is kept.

    Pixels of the same confidence are kept or left out together; between two confidences the curve is that of a random
    order. Errors are |error| / truth, at most 1.

    Attributes:
        kept: (N,) share of the pixels with truth and estimate that is kept, growing to 1.
        error: (N,) mean relative error of those.
        oracle_error: (N,) mean relative error if the pixels were ordered by their true errors.
        area: under the curve, the mean over all shares.
        oracle_area: under the oracle's.
    """

    kept: NDArray[np.float64]
    error: NDArray[np.float64]
    oracle_error: NDArray[np.float64]
    area: float
    oracle_area: float

    @property
    def ause(self) -> float:
        """Area between the two curves: 0 if confidence orders the pixels like their errors; less is better."""
        return self.area - self.oracle_area

    @property
    def unranked_area(self) -> float:
        """The area if all pixels had the same confidence: the mean error."""
        return float(self.error[-1]) if len(self.error) else float("nan")


def sparsify(pixels: ScoredPixels, *, by_solid_angle: bool = True) -> Sparsification:
    """Return the sparsification curve of a range map; an empty curve with NaN areas if no pixel has an estimate.

    E. Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical flow", ECCV 2018, section 5.1.

    Args:
        pixels: estimates, truth and confidence of the pixels.
        by_solid_angle: whether pixels count by their solid angle; otherwise all count the same.

    Raises:
        UsageError: if the pixels have no confidence.
    """
    both = pixels.only_valid()
    if both.confidence is None:
        raise UsageError("sparsification needs the confidence of the pixels")
    weight = both.weight if by_solid_angle else np.ones_like(both.weight)
    if len(weight) == 0:
        nothing = np.zeros(0)
        return Sparsification(nothing, nothing, nothing, float("nan"), float("nan"))
    error = np.minimum(np.abs(both.found - both.true) / both.true, _MAX_ERROR)
    kept, mean, area = _curve(both.confidence.astype(np.float64), error, weight)
    oracle_kept, oracle_mean, oracle_area = _curve(-error, error, weight)
    return Sparsification(kept, mean, np.interp(kept, oracle_kept, oracle_mean), area, oracle_area)


def _curve(
    sureness: NDArray[np.float64], error: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the shares kept, their mean errors, and the area under the curve."""
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
