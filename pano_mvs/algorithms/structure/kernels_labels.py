"""Kernels that give each pixel of a panorama one of a few labels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.kernels import kernel


@kernel
def add_paths(
    costs: NDArray[np.float32],
    penalties: NDArray[np.float32],
    step: tuple[int, int],
    sums: NDArray[np.float32],
) -> None:
    """Add to `sums` the least costs of paths that reach each pixel with each label in one direction.

    Paths along a row go around the panorama once before they count. All others begin at a pole.

    `costs`: (h, w, L). `penalties`: (h, w), cost of a change of the label on the way to a pixel. `step`: −1, 0 or 1
    rows and columns from the pixel before. `sums`: (h, w, L), changed.
    """
    height, width, labels = costs.shape
    down, right = step
    paths = np.zeros((2, width, labels), np.float32)
    for at in range(height):
        row = at if down >= 0 else height - 1 - at
        before, after = paths[at % 2], paths[(at + 1) % 2]
        if down == 0:
            before[:] = np.float32(0)
        for number in range(2 * width if down == 0 else width):
            column = (number if right >= 0 else -1 - number) % width
            # Along a row, the paths before are those of the same row.
            source = (after if down == 0 and number > 0 else before)[(column - right) % width]
            smallest = source.min()
            changed = smallest + penalties[row, column]
            for label in range(labels):
                value = costs[row, column, label] + min(source[label], changed) - smallest
                after[column, label] = value
                if down != 0 or number >= width:
                    sums[row, column, label] += value
