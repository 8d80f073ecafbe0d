"""Samples of matches for a robust estimation, and the required number of samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def draw_samples(rng: np.random.Generator, count: int, *, batch: int, sample: int) -> NDArray[np.int64]:
    """Return positions of distinct matches among `count` matches, (batch, sample)."""
    samples = rng.integers(count, size=(batch, sample))
    repeated = np.flatnonzero((np.diff(np.sort(samples, axis=1), axis=1) == 0).any(axis=1))
    for row in repeated:
        samples[row] = rng.choice(count, sample, replace=False)
    return samples


def samples_needed(inlier_ratio: float, confidence: float, *, sample: int) -> float:
    """Return the number of samples after which one without outliers has been drawn with the given probability."""
    clean = inlier_ratio**sample
    if clean >= 1:
        return 0.0
    return float(np.log1p(-confidence) / np.log1p(-clean)) if clean > 0 else np.inf
