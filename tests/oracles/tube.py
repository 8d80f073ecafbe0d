"""Semi-global matching among candidates around two guides, plainly: one path at a time, one candidate at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def follow(
    costs: NDArray[Any], guides: NDArray[Any], penalties: NDArray[Any], p1: float, one_surface: float
) -> NDArray[np.float64]:
    """Return L along one path: costs (N, 2, K), guides (N, 2), penalties (N,)."""
    result = np.zeros(costs.shape)
    before = np.zeros(costs.shape[1:])
    last = np.zeros(2)
    for i in range(len(costs)):
        floor = before.min()
        for a in range(2):
            for k in range(costs.shape[2]):
                options = [floor + penalties[i]]
                for b in range(2):
                    if abs(guides[i, a] - last[b]) > one_surface:
                        continue
                    options.append(before[b, k])
                    options += [before[b, other] + p1 for other in (k - 1, k + 1) if 0 <= other < costs.shape[2]]
                result[i, a, k] = costs[i, a, k] + min(options) - floor
        before, last = result[i], guides[i]
    return result
