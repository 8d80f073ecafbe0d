"""Census and, with a quarter of its weight, differences of grey levels and of their gradients, each truncated.

With equal weights a mirror's picture is matched behind it; without grey levels plain walls are not matched.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.costs import kernels_constants
from pano_mvs.algorithms.sweep.costs.census import census_cost, max_census
from pano_mvs.algorithms.sweep.costs.cost import SweepCost
from pano_mvs.algorithms.sweep.costs.kernels_constants import GREY_WEIGHT, MAX_COLOR_COST, MAX_GRADIENT_COST
from pano_mvs.algorithms.sweep.costs.sad_gradient import sad_gradient_cost
from pano_mvs.algorithms.sweep.windows import CostWindow

_CENSUS_SHARE = 4
# Of one colour instead of three, every difference is a third.
_MAX_GREY = GREY_WEIGHT * (MAX_COLOR_COST + MAX_GRADIENT_COST) // 3


def census_weight(radius: int) -> int:
    """Return what a disagreement counts beside grey levels: at worst, all of them four times as much."""
    return _CENSUS_SHARE * max(1, round(_MAX_GREY / max(1, max_census(radius))))


def census_gradient_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], window: CostWindow
) -> NDArray[np.float64]:
    """Return the census cost plus the differences of grey levels and of their gradients, each truncated, (H, W)."""
    grey = sad_gradient_cost(np.repeat(reference, 3, axis=-1), np.repeat(warped, 3, axis=-1), window) / 3
    return np.asarray(census_weight(window.radius) * census_cost(reference, warped, window) + GREY_WEIGHT * grey)


CENSUS_GRADIENT = SweepCost(
    "census_gradient",
    census_gradient_cost,
    minds_exposure=True,
    min_window=3,
    worst=lambda radius: float(census_weight(radius) * max_census(radius) + _MAX_GREY),
    kernel=kernels_constants.CENSUS_GRADIENT,
)
