"""1 − zero-mean normalised cross-correlation over the window; insensitive to exposure."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.costs import kernels_constants
from pano_mvs.algorithms.sweep.costs.cost import SweepCost
from pano_mvs.algorithms.sweep.costs.kernels_constants import ZNCC_NOISE_VARIANCE
from pano_mvs.algorithms.sweep.windows import CostWindow, box_mean


def zncc_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], window: CostWindow
) -> NDArray[np.float64]:
    """Return 1 − ρ, ρ the correlation over each pixel's window with some noise in both variances, (H, W)."""
    ours, theirs = reference[..., 0].astype(np.float64), warped[..., 0].astype(np.float64)
    mean_r, mean_w = box_mean(ours, window), box_mean(theirs, window)
    variance_r = np.maximum(box_mean(ours**2, window) - mean_r**2, 0) + ZNCC_NOISE_VARIANCE
    variance_w = np.maximum(box_mean(theirs**2, window) - mean_w**2, 0) + ZNCC_NOISE_VARIANCE
    rho = (box_mean(ours * theirs, window) - mean_r * mean_w) / np.sqrt(variance_r * variance_w)
    return np.asarray(1 - np.clip(rho, -1, 1))


ZNCC = SweepCost(
    "zncc",
    zncc_cost,
    radius=0,
    averages_itself=True,
    min_window=3,
    worst=lambda _: 2.0,
    kernel=kernels_constants.ZNCC,
)
