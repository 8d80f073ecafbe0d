"""Compiled: two guiding surfaces for every pixel near depth edges."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_records import F32
from pano_mvs.core.kernels import kernel

_F = np.float32
_INFINITE = np.float32(np.inf)


@kernel
def _means(positions: F32, y: int, x: int, side: int, middle: float, layers: F32) -> None:
    """Write the means of what is nearer than `middle` around a pixel and of the rest; the same if nothing is nearer."""
    below = above = _F(0)
    count = 0
    for j in range(side):
        for i in range(side):
            value = positions[y + j, x + i]
            if value < middle:
                below += value
                count += 1
            else:
                above += value
    layers[1, y, x] = above / _F(side * side - count)
    layers[0, y, x] = below / _F(count) if count else layers[1, y, x]


@kernel
def split_layers(positions: F32, radius: int, least_gap: float, layers: F32) -> None:
    """Separate the two surfaces around each pixel where they meet.

    Args:
        positions: (H + 2 radius, W + 2 radius) float32 positions among planes, padded over the seam and the poles.
        radius: pixels on either side that are looked at.
        least_gap: planes between the nearest and the farthest of them from which on there are two surfaces.
        layers: (2, H, W) float32, written: the mean of those around that are nearer than the middle between nearest and
            farthest, and that of the others; twice the mean of all where there is one surface.
    """
    side = 2 * radius + 1
    for y in range(layers.shape[1]):
        for x in range(layers.shape[2]):
            low = high = positions[y, x]
            for j in range(side):
                for i in range(side):
                    low = min(low, positions[y + j, x + i])
                    high = max(high, positions[y + j, x + i])
            middle = _F(0.5) * (low + high) if high - low >= least_gap else -_INFINITE
            _means(positions, y, x, side, middle, layers)


@kernel
def adopt_candidates(found: F32, costs: F32, radius: int, least_gap: float, layer: F32) -> None:
    """Replace a guide around candidates that are cheaper, by the mean of those around that agree with the cheapest.

    Args:
        found: (H + 2 radius, W + 2 radius) float32 positions of the candidates, padded over the seam and the poles.
        costs: likewise their costs; infinite where there is none.
        radius: pixels on either side that are looked at.
        least_gap: planes from which on candidates are of different surfaces.
        layer: (H, W) float32, written where there is a candidate around.
    """
    side = 2 * radius + 1
    for y in range(layer.shape[0]):
        for x in range(layer.shape[1]):
            least, place = _INFINITE, _F(0)
            for j in range(side):
                for i in range(side):
                    if costs[y + j, x + i] < least:
                        least, place = costs[y + j, x + i], found[y + j, x + i]
            if least == _INFINITE:
                continue
            total, count = _F(0), 0
            for j in range(side):
                for i in range(side):
                    if costs[y + j, x + i] < _INFINITE and abs(found[y + j, x + i] - place) < least_gap:
                        total += found[y + j, x + i]
                        count += 1
            layer[y, x] = total / _F(count)
