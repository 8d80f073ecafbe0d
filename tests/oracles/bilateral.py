"""The bilateral solver's linear system with dense matrices, and its solution by elimination."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.bilateral_solver import SphereCells


def corner_weights(cells: SphereCells, row: int, column: int) -> NDArray[np.float64]:
    gap, down = cells.gap_of_row[row], cells.weight_row[row]
    upper, lower = cells.weight_upper[gap, column], cells.weight_lower[gap, column]
    return np.array([(1 - down) * (1 - upper), (1 - down) * upper, down * (1 - lower), down * lower])


def dense_system(
    target: NDArray[np.float64],
    weight: NDArray[np.float64],
    colors: NDArray[np.int64],
    cells: SphereCells,
    smoothness: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return A, b and S (V, N) of min λ yᵀ (D_m − D_n B̄ D_n) y + Σ c (Sᵀ y − t)²; `colors` is (H, W, 3) bins."""
    height, width = target.shape
    numbers: dict[tuple[int, ...], int] = {}
    entries = []
    for row in range(height):
        for column in range(width):
            corners = cells.corners[cells.element_of_pixel[cells.gap_of_row[row], column]]
            for cell, share in zip(corners, corner_weights(cells, row, column), strict=True):
                vertex = numbers.setdefault((int(cell), *map(int, colors[row, column])), len(numbers))
                entries.append((vertex, row * width + column, share))
    splat = np.zeros((len(numbers), height * width))
    for vertex, pixel, share in entries:
        splat[vertex, pixel] += share
    blur = 10.0 * np.eye(len(numbers))
    for (cell, *color), vertex in numbers.items():
        for position in range(cells.starts[cell], cells.starts[cell + 1]):
            other = numbers.get((int(cells.neighbours[position]), *color))
            if other is not None:
                blur[vertex, other] += cells.strengths[position]
        for channel in range(3):
            for step in (-1, 1):
                moved = list(color)
                moved[channel] += step
                other = numbers.get((cell, *moved))
                if other is not None:
                    blur[vertex, other] += 1
    mass = splat.sum(axis=1)
    n = np.ones_like(mass)
    for _ in range(10):
        n = np.sqrt(n * mass / (blur @ n))
    smooth = np.diag(n * (blur @ n)) - n[:, None] * blur * n
    matrix = smoothness * smooth + (splat * weight.ravel()) @ splat.T
    return matrix, splat @ (weight * target).ravel(), splat
