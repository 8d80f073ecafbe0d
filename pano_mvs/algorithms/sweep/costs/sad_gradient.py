"""Differences of R, G and B and of their gradients, each truncated.

A. Hosni, C. Rhemann, M. Bleyer, C. Rother, M. Gelautz, "Fast cost-volume filtering for visual correspondence and
beyond", TPAMI 2013.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.costs import kernels_constants
from pano_mvs.algorithms.sweep.costs.cost import SweepCost
from pano_mvs.algorithms.sweep.costs.kernels_constants import MAX_COLOR_COST, MAX_GRADIENT_COST
from pano_mvs.algorithms.sweep.costs.sad import absolute_differences
from pano_mvs.algorithms.sweep.windows import CostWindow, neighbours


def sad_gradient_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.floating[Any]], window: CostWindow
) -> NDArray[np.float64]:
    """Return the differences of colours and those of their gradients, each truncated, (H, W).

    Gradients are central differences, not halved: over two rows, and over two of the window's columns.
    """
    columns = window.columns[:, window.radius + 1]
    none = np.zeros_like(columns)
    gradient = np.zeros(reference.shape[:2])
    for color in np.moveaxis(reference.astype(np.float64) - warped, -1, 0):
        gradient += np.abs(neighbours(color, 0, columns) - neighbours(color, 0, -columns))
        gradient += np.abs(neighbours(color, 1, none) - neighbours(color, -1, none))
    colors = np.minimum(absolute_differences(reference, warped, window), MAX_COLOR_COST)
    return np.asarray(colors + np.minimum(gradient, MAX_GRADIENT_COST))


SAD_GRADIENT = SweepCost(
    "sad_gradient",
    sad_gradient_cost,
    colors=True,
    minds_exposure=True,
    radius=1,
    worst=lambda _: float(MAX_COLOR_COST + MAX_GRADIENT_COST),
    kernel=kernels_constants.SAD_GRADIENT,
)
