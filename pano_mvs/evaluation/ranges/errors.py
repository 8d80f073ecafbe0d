"""Averages of range errors over pixels, by the names that all commands and files use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.ranges.pixels import weighted_mean

DELTAS = {"delta_105": 1.05, "delta_125": 1.25, "delta_125_2": 1.25**2, "delta_125_3": 1.25**3}
"""Name of a score to the largest ratio of estimate and truth, either way round, of a correct pixel."""


@dataclass(frozen=True, slots=True)
class BadLimit:
    """An error above which a pixel is bad.

    Attributes:
        value: the limit, a share of the truth or a length in its unit.
        relative: whether the limit is a share.
    """

    value: float
    relative: bool = True

    @property
    def name(self) -> str:
        """`bad_5` for 5 % of the truth, `bad_abs_0.1` for a tenth of the truth's unit."""
        return f"bad_{100 * self.value:g}" if self.relative else f"bad_abs_{self.value:g}"

    @classmethod
    def from_text(cls, text: str) -> BadLimit:
        """Return the limit written as "5%" or, in the truth's unit, as "0.1".

        Raises:
            UsageError: if it is neither, or not positive.
        """
        relative = text.strip().endswith("%")
        try:
            value = float(text.strip().removesuffix("%")) / (100 if relative else 1)
        except ValueError:
            value = float("nan")
        if not 0 < value < float("inf"):
            raise UsageError(f"'{text}' is not a limit for bad pixels: write a share (5%) or a length (0.1)")
        return cls(value, relative)


DEFAULT_BAD = (BadLimit(0.05),)


def range_errors(
    found: NDArray[np.float64],
    true: NDArray[np.float64],
    weight: NDArray[np.float64],
    *,
    peak: float = 10.0,
    bad: Sequence[BadLimit] = DEFAULT_BAD,
) -> dict[str, float]:
    """Return the weighted averages of the errors of pixels; NaN of no pixels.

    With e = |found − true|: mse is the mean of (e / peak)², psnr_db −10 log10 of it, rmse its root times the peak, mae
    the mean of e, and abs_rel the mean of e / true. A delta is the share of pixels with max(found / true, true / found)
    below its limit, a bad the share with e / true (or e) above its limit.

    Args:
        found: (N,) estimates; where NaN, e is the truth itself, and the pixel is bad and fails every delta.
        true: (N,) true ranges, positive.
        weight: (N,) weight of each pixel.
        peak: the range that counts as 1 in mse, in the truth's unit.
        bad: limits of bad pixels.
    """
    valid = np.isfinite(found)
    error = np.where(valid, np.abs(found - true), true)
    relative = error / true
    ratio = np.full_like(true, np.inf)
    np.divide(np.maximum(found, true), np.minimum(found, true), out=ratio, where=valid & (found > 0))
    averages = mse_scores(weighted_mean((error / peak) ** 2, weight), peak)
    averages |= {"mae": weighted_mean(error, weight), "abs_rel": weighted_mean(relative, weight)}
    averages |= {name: weighted_mean(ratio < limit, weight) for name, limit in DELTAS.items()}
    for limit in bad:
        beyond = (relative if limit.relative else error) > limit.value
        averages[limit.name] = weighted_mean(beyond | ~valid, weight)
    return averages


def mse_scores(mse: float, peak: float) -> dict[str, float]:
    """Return a mean of squared errors, in units of the squared peak, as mse, psnr_db and rmse."""
    with np.errstate(divide="ignore"):
        return {"mse": mse, "psnr_db": float(-10 * np.log10(mse)), "rmse": float(peak * np.sqrt(mse))}
