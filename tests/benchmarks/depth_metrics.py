"""How far a range map is from the truth."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.evaluation.ranges.view_scores import ScoreSettings, has_range, score_view


@dataclass(frozen=True, slots=True)
class DepthMetrics:
    """How far a range map is from the truth: the usual ones of the scores of `score_view`, as attributes.

    Two protocols. FILLED (no prefix): every pixel with truth counts, and one without an estimate has an error equal
    to the truth. VALID-ONLY (prefix `valid_`): only pixels with an estimate count; read it with `completeness`. A `w_`
    weights each pixel by its solid angle, so that the poles do not count for more than they show. NaN where no pixel
    counts.

    Attributes:
        pixels: number of pixels with truth.
        mse: mean of squared (range error / peak).
        psnr_db: −10 log10(mse).
        mae: mean absolute range error, in the truth's unit.
        rmse: root of the mean squared range error, in the truth's unit.
        abs_rel: mean of |error| / truth.
        delta_105: share of pixels with max(estimate / truth, truth / estimate) < 1.05.
        delta_125: the same with 1.25.
        bad_5: share of pixels with |error| / truth > 5 %.
        completeness: share of pixels with an estimate.
        median_relative_error: median of |error| / truth over pixels with an estimate.
    """

    pixels: int
    mse: float
    psnr_db: float
    mae: float
    rmse: float
    abs_rel: float
    delta_105: float
    delta_125: float
    bad_5: float
    completeness: float
    w_mse: float
    w_psnr_db: float
    w_mae: float
    w_rmse: float
    w_abs_rel: float
    w_delta_105: float
    w_delta_125: float
    w_bad_5: float
    w_completeness: float
    valid_mse: float
    valid_psnr_db: float
    valid_mae: float
    valid_rmse: float
    valid_abs_rel: float
    valid_delta_105: float
    valid_delta_125: float
    valid_bad_5: float
    valid_w_mae: float
    valid_w_abs_rel: float
    valid_w_delta_105: float
    median_relative_error: float

    def as_dict(self) -> dict[str, float]:
        """Return all figures by name."""
        return dataclasses.asdict(self)


def depth_metrics(
    estimated: NDArray[np.floating],
    truth: NDArray[np.floating],
    *,
    scale: float = 1.0,
    peak: float = 10.0,
    mask: NDArray[np.bool_] | None = None,
) -> DepthMetrics:
    """Return how far a range map is from the truth.

    Args:
        estimated: (H, W) ranges in scene units; NaN is invalid.
        truth: (H, W) true ranges; infinite or NaN where there is no surface: such pixels are left out.
        scale: factor from scene units to the truth's unit, from the cameras' centres and never from the ranges.
        peak: the range that counts as 1 in `mse`, in the truth's unit.
        mask: (H, W), False leaves a pixel out.

    Raises:
        UsageError: if the shapes differ, or scale or peak is not positive.
    """
    found = score_view(estimated, truth, scale=scale, mask=mask, settings=ScoreSettings(peak=peak))
    chosen = {field.name: found.scores[field.name] for field in dataclasses.fields(DepthMetrics)[1:]}
    return DepthMetrics(pixels=found.pixels, **chosen)


def constant_baseline(
    truth: NDArray[np.floating], *, peak: float = 10.0, mask: NDArray[np.bool_] | None = None
) -> DepthMetrics:
    """Return what the median of the truth scores as a constant range map: the zero of every scale.

    Args:
        truth: (H, W) true ranges; infinite or NaN where there is no surface.
        peak: as in `depth_metrics`.
        mask: as in `depth_metrics`.
    """
    counted = has_range(truth)
    if mask is not None:
        counted &= mask
    middle = np.median(truth[counted]) if counted.any() else np.nan
    return depth_metrics(np.full(truth.shape, middle, np.float64), truth, peak=peak, mask=mask)
