"""Hypotheses of a robust estimation: minimal solvers, samples, and the required number of samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.essential import essential_from_bearings
from pano_mvs.algorithms.two_view.five_point import essentials_from_five

FloatArray = NDArray[np.float64]
Solver: TypeAlias = Literal["five_point", "eight_point"]


@dataclass(frozen=True)
class MinimalSolver:
    """A minimal solver.

    Attributes:
        sample: number of matches in a sample.
        batch: number of samples that are drawn together.
        solve: (N, sample, 3) bearings of the first and of the second image to (K, 3, 3) essential matrices.
        models: maximum number of essential matrices from one sample.
    """

    sample: int
    batch: int
    solve: Callable[[FloatArray, FloatArray], FloatArray]
    models: int


def _five(first: FloatArray, second: FloatArray) -> FloatArray:
    return essentials_from_five(first, second)[0]


SOLVERS: dict[Solver, MinimalSolver] = {
    "five_point": MinimalSolver(sample=5, batch=64, solve=_five, models=10),
    "eight_point": MinimalSolver(sample=8, batch=256, solve=essential_from_bearings, models=1),
}


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
