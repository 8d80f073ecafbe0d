"""The paper's cost: the sum of absolute differences of R, G and B."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.costs import kernels_constants
from pano_mvs.algorithms.sweep.costs.cost import SweepCost
from pano_mvs.algorithms.sweep.windows import CostWindow

# In grey levels, summed over R, G and B: a pixel that differs by more is simply wrong.
_MAX_SAD = 96.0


def absolute_differences(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], _: CostWindow
) -> NDArray[np.float64]:
    """Return the sum of the absolute differences of all colours, (H, W)."""
    difference: NDArray[np.float64] = np.abs(reference.astype(np.float64) - warped).sum(axis=-1)
    return difference


SAD = SweepCost(
    "sad",
    absolute_differences,
    colors=True,
    minds_exposure=True,
    radius=0,
    worst=lambda _: _MAX_SAD,
    kernel=kernels_constants.SAD,
)
