"""Census: the Hamming distance of the signs of differences to the window's centre; insensitive to exposure.

R. Zabih, J. Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.costs import kernels_constants
from pano_mvs.algorithms.sweep.costs.cost import SweepCost
from pano_mvs.algorithms.sweep.windows import CostWindow


def census_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], window: CostWindow
) -> NDArray[np.float64]:
    """Return how many neighbours have another order against the centre in one picture than in the other, (H, W)."""
    ours, theirs = reference[..., 0], warped[..., 0]
    differs = np.zeros(ours.shape)
    for our_neighbour, their_neighbour in zip(window.neighbours(ours), window.neighbours(theirs), strict=True):
        differs += (our_neighbour > ours) != (their_neighbour > theirs)
    return differs


def max_census(radius: int) -> int:
    """Return the number of neighbours in a window."""
    return (2 * radius + 1) ** 2 - 1


CENSUS = SweepCost("census", census_cost, min_window=3, worst=max_census, kernel=kernels_constants.CENSUS)
