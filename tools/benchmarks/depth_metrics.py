"""The usual scores of a range map (`pano_mvs_evaluation`), as attributes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray
from pano_mvs_evaluation.ranges.view_scores import ScoreSettings, score_view


def depth_metrics(
    estimated: NDArray[np.floating],
    truth: NDArray[np.floating],
    *,
    scale: float = 1.0,
    peak: float = 10.0,
    mask: NDArray[np.bool_] | None = None,
) -> SimpleNamespace:
    """Return the number of `pixels` with truth, and the scores of `score_view` by their names."""
    found = score_view(estimated, truth, scale=scale, mask=mask, settings=ScoreSettings(peak=peak))
    return SimpleNamespace(pixels=found.pixels, **found.scores)


def constant_baseline(truth: NDArray[np.floating]) -> SimpleNamespace:
    """Return what the median of the truth scores as a constant range map."""
    true = truth[np.isfinite(truth) & (truth > 0)]
    return depth_metrics(np.full(truth.shape, np.median(true) if len(true) else np.nan), truth)
