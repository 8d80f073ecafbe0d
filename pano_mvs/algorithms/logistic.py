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
    # another measurement, and the value from which this one counts in full: with less of it, this one counts less in
    # proportion; None: always in full
    full_from: tuple[str, float] | None = None

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


def counted_share(columns: Mapping[str, FloatArray], full_from: tuple[str, float]) -> FloatArray:
    """Return how far a measurement counts (N,), 0 to 1, by another one; in full where that was not measured."""
    name, full = full_from
    other = columns.get(name, np.array([np.nan]))
    return np.where(np.isfinite(other), np.clip(other / full, 0.0, 1.0), 1.0)


@dataclass(frozen=True)
class Model:
    """The fitted model."""

    intercept: float  # logarithm of the odds where every measurement is the best
    terms: Mapping[str, Term]  # measurement to what it contributes

    def contributions(self, row: Mapping[str, float]) -> dict[str, float]:
        """Return what each measurement of a row adds to the logarithm of the odds; 0 or less."""
        columns = {name: np.array([row.get(name, np.nan)]) for name in (*row, *self.terms)}
        return {name: float(self._contribution(name, columns)[0]) for name in self.terms}

    def _contribution(self, name: str, columns: Mapping[str, FloatArray]) -> FloatArray:
        term = self.terms[name]
        found = term.contributions(columns[name])
        return found if term.full_from is None else found * counted_share(columns, term.full_from)

    def probability(self, row: Mapping[str, float]) -> float:
        """Return the probability for one row of measurements."""
        return float(1 / (1 + np.exp(-self.intercept - sum(self.contributions(row).values()))))

    def log_odds(self, columns: Mapping[str, FloatArray]) -> FloatArray:
        """Return the logarithms of the odds (N,) for columns (N,) of measurements, NaN where missing."""
        found = np.full(len(next(iter(columns.values()))), self.intercept)
        for name in self.terms:
            found += self._contribution(name, columns)
        return found

    def probabilities(self, columns: Mapping[str, FloatArray]) -> FloatArray:
        """Return the probabilities (N,) for columns (N,) of measurements, NaN where missing."""
        return np.asarray(1 / (1 + np.exp(-self.log_odds(columns))))
