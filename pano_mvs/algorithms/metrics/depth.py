"""How far a range map is from the truth."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pixel_solid_angle

_DELTA_105, _DELTA_125, _BAD = 1.05, 1.25, 0.05


@dataclass(frozen=True, slots=True)
class DepthMetrics:
    """How far a range map is from the truth.

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
    if estimated.shape != truth.shape or truth.ndim != 2 or (mask is not None and mask.shape != truth.shape):
        raise UsageError(f"estimated {estimated.shape}, truth {truth.shape} and mask must be (H, W) of one size")
    if not (scale > 0 and peak > 0):
        raise UsageError(f"scale and peak must be positive, got {scale} and {peak}")
    counted = np.isfinite(truth) & (truth > 0)
    if mask is not None:
        counted &= mask
    true = truth[counted].astype(np.float64)
    found = scale * estimated[counted].astype(np.float64)
    weight = np.broadcast_to(pixel_solid_angle(truth.shape)[:, None], truth.shape)[counted]
    valid = np.isfinite(found)
    equal = np.ones_like(true)
    filled = _averages(found, true, equal, peak)
    weighted = _averages(found, true, weight, peak)
    only = _averages(found[valid], true[valid], equal[valid], peak)
    weighted_only = _averages(found[valid], true[valid], weight[valid], peak)
    relative = np.abs(found[valid] - true[valid]) / true[valid]
    return DepthMetrics(
        pixels=int(counted.sum()),
        completeness=_mean(valid, equal),
        w_completeness=_mean(valid, weight),
        **filled,
        **{f"w_{name}": value for name, value in weighted.items()},
        **{f"valid_{name}": value for name, value in only.items()},
        **{f"valid_w_{name}": weighted_only[name] for name in ("mae", "abs_rel", "delta_105")},
        median_relative_error=float(np.median(relative)) if len(relative) else float("nan"),
    )


def constant_baseline(
    truth: NDArray[np.floating], *, peak: float = 10.0, mask: NDArray[np.bool_] | None = None
) -> DepthMetrics:
    """Return what the median of the truth scores as a constant range map: the zero of every scale.

    Args:
        truth: (H, W) true ranges; infinite or NaN where there is no surface.
        peak: as in `depth_metrics`.
        mask: as in `depth_metrics`.
    """
    counted = np.isfinite(truth) & (truth > 0)
    if mask is not None:
        counted &= mask
    middle = np.median(truth[counted]) if counted.any() else np.nan
    return depth_metrics(np.full(truth.shape, middle, np.float64), truth, peak=peak, mask=mask)


def _averages(
    found: NDArray[np.float64], true: NDArray[np.float64], weight: NDArray[np.float64], peak: float
) -> dict[str, float]:
    """Return the weighted averages of one protocol; a found NaN has an error equal to the truth."""
    error = np.abs(np.where(np.isfinite(found), found - true, true))
    relative = error / true
    # A missing or negative estimate has no ratio: it fails every delta.
    ratio = np.full_like(true, np.inf)
    np.divide(np.maximum(found, true), np.minimum(found, true), out=ratio, where=np.isfinite(found) & (found > 0))
    mse = _mean((error / peak) ** 2, weight)
    with np.errstate(divide="ignore"):
        psnr_db = float(-10 * np.log10(mse))
    return {
        "mse": mse,
        "psnr_db": psnr_db,
        "mae": _mean(error, weight),
        "rmse": float(peak * np.sqrt(mse)),
        "abs_rel": _mean(relative, weight),
        "delta_105": _mean(ratio < _DELTA_105, weight),
        "delta_125": _mean(ratio < _DELTA_125, weight),
        "bad_5": _mean(relative > _BAD, weight),
    }


def _mean(values: NDArray[np.float64] | NDArray[np.bool_], weight: NDArray[np.float64]) -> float:
    """Return the weighted mean, NaN of nothing."""
    total = float(weight.sum())
    return float((values * weight).sum()) / total if total > 0 else float("nan")
