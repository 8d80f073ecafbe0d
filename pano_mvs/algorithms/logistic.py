"""A monotone logistic model: the probability that something is so, from what was measured of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Term:
    """What one measurement contributes to the logarithm of the odds: 0 at best, negative otherwise.

    The contribution falls piecewise linearly from one knot to the next and is constant beyond the last one on either
    side, so that no measurement, however extreme, counts for more than the draws that it was fitted on.
    """

    # (K) values from the worst to the best: increasing if more is better, otherwise decreasing
    knots: tuple[float, ...]
    losses: tuple[float, ...]  # (K − 1) what is lost from each knot to the one before it; not negative
    missing: float  # what is lost if it was not measured; not negative

    def lost(self, values: FloatArray) -> FloatArray:
        """Return how far each value (N,) stays behind the best one on each step, (N, K), the last for missing ones."""
        return steps_behind(values, self.knots)

    def contributions(self, values: FloatArray) -> FloatArray:
        """Return the contributions (N,) of values (N,), NaN where missing."""
        found: FloatArray = -self.lost(values) @ np.array([*self.losses, self.missing])
        return found


def steps_behind(values: FloatArray, knots: tuple[float, ...]) -> FloatArray:
    """Return for values (N,) which part of each step between knots they lack, (N, K); the last column marks NaN."""
    behind = np.zeros((len(values), len(knots)))
    known = np.isfinite(values)
    for step, (worse, better) in enumerate(pairwise(knots)):
        behind[known, step] = np.clip((better - values[known]) / (better - worse), 0.0, 1.0)
    behind[~known, -1] = 1.0
    return behind


@dataclass(frozen=True)
class Model:
    """The fitted model."""

    intercept: float  # logarithm of the odds where every measurement is the best
    terms: Mapping[str, Term]  # measurement to what it contributes

    def contributions(self, row: Mapping[str, float]) -> dict[str, float]:
        """Return what each measurement of a row adds to the logarithm of the odds; 0 or less."""
        return {
            name: float(term.contributions(np.array([row.get(name, np.nan)]))[0]) for name, term in self.terms.items()
        }

    def probability(self, row: Mapping[str, float]) -> float:
        """Return the probability for one row of measurements."""
        return float(1 / (1 + np.exp(-self.intercept - sum(self.contributions(row).values()))))

    def log_odds(self, columns: Mapping[str, FloatArray]) -> FloatArray:
        """Return the logarithms of the odds (N,) for columns (N,) of measurements, NaN where missing."""
        found = np.full(len(next(iter(columns.values()))), self.intercept)
        for name, term in self.terms.items():
            found += term.contributions(columns[name])
        return found

    def probabilities(self, columns: Mapping[str, FloatArray]) -> FloatArray:
        """Return the probabilities (N,) for columns (N,) of measurements, NaN where missing."""
        return np.asarray(1 / (1 + np.exp(-self.log_odds(columns))))
