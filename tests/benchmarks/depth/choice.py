"""Choose a setting from its scores on many places, such that it also holds on places that were not looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

# A place may lose this much, in points of the score, which small changes of any kind cost.
TOLERANCE = 0.3


@dataclass(frozen=True)
class Worth:
    """What a setting is worth on many places, compared with the defaults.

    Attributes:
        gains: points that each place gains, by name.
    """

    gains: Mapping[str, float]

    @property
    def mean(self) -> float:
        """Mean of all places."""
        return float(np.mean(list(self.gains.values())))

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        values = list(self.gains.values())
        return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")

    @property
    def worst(self) -> str:
        """The place that gains least."""
        return min(self.gains, key=lambda place: (self.gains[place], place))

    @property
    def best(self) -> str:
        """The place that gains most."""
        return max(self.gains, key=lambda place: (self.gains[place], place))

    @property
    def winners(self) -> int:
        """Number of places that gain."""
        return sum(gain > 0 for gain in self.gains.values())

    @property
    def folds(self) -> int:
        """Number of places on which the setting is confirmed.

        A place confirms the setting if it does not lose, and the mean of the other places wins.
        """
        return sum(self.mean_without(place) > 0 and gain >= -TOLERANCE for place, gain in self.gains.items())

    @property
    def is_chosen(self) -> bool:
        """Whether every place, left out in turn, confirms the setting."""
        return self.folds == len(self.gains)

    def mean_without(self, place: str) -> float:
        """Return the mean gain of all other places; 0 if there are none."""
        others = [gain for other, gain in self.gains.items() if other != place]
        return float(np.mean(others)) if others else 0.0


def worth_of(default: Mapping[str, float], setting: Mapping[str, float]) -> Worth:
    """Return the gain of each place.

    Args:
        default: scores of the defaults, by place.
        setting: scores of the setting, by place; places that are not in both are left out.
    """
    return Worth({place: setting[place] - default[place] for place in default if place in setting})


def left_out_gain(worths: Mapping[str, Worth]) -> float:
    """Return what the search as such is worth on a place that it has not seen.

    For each place, the setting with the best mean over the other places is chosen, or the defaults if none wins there;
    the result is the mean of what the places that were left out gain by it.
    """
    places = list(next(iter(worths.values())).gains)
    gains = []
    for place in places:
        means = {name: worth.mean_without(place) for name, worth in worths.items()}
        best = max(means, key=lambda name: means[name])
        gains.append(worths[best].gains[place] if means[best] > 0 else 0.0)
    return float(np.mean(gains))
