"""Compiled: the most likely planes of the pixels of some rows, given the pictures and the current planes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.kernels_match import (
    STRETCH,
    SUM_AB,
    SUM_B,
    SUM_BB,
    SUM_G,
    SUM_GA,
    SUM_GB,
    SUM_GG,
    SUMS,
    Sources,
    sum_windows,
    weigh_window,
)
from pano_mvs.algorithms.patchmatch.kernels_planes import sines_of_columns
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import elevation_from_y

FloatArray = NDArray[np.float64]
Reference = tuple[NDArray[np.float32], NDArray[np.float32], int, FloatArray, NDArray[np.int64], NDArray[np.int64]]
Numbers = tuple[np.float32, np.float32, float, float, float, np.float32]

_F = np.float32
_U = np.uint64
# Windows with a lower correlation show different surfaces.
_MIN_CORRELATION = 0.2


@kernel
def correlate_sources(
    sums: NDArray[np.float32],
    votes: NDArray[np.bool_],
    variance: NDArray[np.float32],
    noise: np.float32,
    correlations: NDArray[np.float32],
) -> None:
    """Write the correlation of each source with the reference, (S, n); −2 where it does not count."""
    for s in range(correlations.shape[0]):
        for i in range(_U(correlations.shape[1])):
            b = sums[s, SUM_B, i]
            spread = sums[s, SUM_BB, i] - b * b + noise
            correlation = sums[s, SUM_AB, i] / np.sqrt(spread * (variance[i] + noise))
            correlations[s, i] = correlation if votes[s, i] else _F(-2)


@kernel
def least_of_best(correlations: NDArray[np.float32], i: int, held: NDArray[np.float32]) -> np.float32:
    """Return the least correlation of the better half of the sources that count (rounded up); 1 if there is none."""
    votes = 0
    for s in range(correlations.shape[0]):
        value = correlations[s, i]
        if value >= _F(-1.5):
            place = votes
            while place > 0 and held[place - 1] < value:
                held[place] = held[place - 1]
                place -= 1
            held[place] = value
            votes += 1
    return held[(votes + 1) // 2 - 1] if votes else _F(2)


@kernel
def add_source(
    sums: NDArray[np.float32],
    i: int,
    correlation: float,
    variance: np.float32,
    noise: np.float32,
    samples: float,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Add one source's measurement of pixel i to the normal equations of (α, β, γ).

    With ã and b̃ the samples over their spread and J = ∂b̃ / ∂(α, β, γ), less its mean and its component along b̃ (which
    makes both invariant to brightness and contrast): Σ w J Jᵀ and Σ w J ã, over the variance of ã that b̃ leaves
    unexplained.
    """
    mean = np.float64(sums[SUM_B, i])
    spread = sums[SUM_BB, i] - mean * mean + noise
    information = samples * spread / (noise + spread * (1 - correlation * correlation))
    both = np.sqrt(np.float64(variance + noise) * spread)
    along = (
        (sums[SUM_GB, i] - sums[SUM_G, i] * mean) / spread,
        (sums[SUM_GB + 1, i] - sums[SUM_G + 1, i] * mean) / spread,
        (sums[SUM_GB + 2, i] - sums[SUM_G + 2, i] * mean) / spread,
    )
    entry = 0
    for a in range(3):
        right[a] += information * (sums[SUM_GA + a, i] / both - correlation * along[a])
        for b in range(a, 3):
            moment = sums[SUM_GG + entry, i] - np.float64(sums[SUM_G + a, i]) * sums[SUM_G + b, i]
            normal[entry] += information * (moment / spread - along[a] * along[b])
            entry += 1


@kernel
def solve_first(a: FloatArray, b: FloatArray) -> float:
    """Return the first unknown of a positive definite 3×3 system, a = (xx, xy, xz, yy, yz, zz)."""
    c00, c01, c02 = a[3] * a[5] - a[4] * a[4], a[2] * a[4] - a[1] * a[5], a[1] * a[4] - a[2] * a[3]
    determinant = a[0] * c00 + a[1] * c01 + a[2] * c02
    first: float = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
    return first


@kernel
def most_likely_steps(
    sums: NDArray[np.float32],
    correlations: NDArray[np.float32],
    variance: NDArray[np.float32],
    noise: np.float32,
    prior: tuple[float, float],
    samples: float,
    weights: NDArray[np.float32],
    weighted: bool,
    steps: NDArray[np.float32],
) -> None:
    """Write the most likely step of α, (n,), given the pictures and the current planes.

    Args:
        sums: (S, SUMS, STRETCH) float32 of the windows, see `sum_windows`.
        correlations: (S, n) float32.
        variance: (n,) float32 of the reference's windows.
        noise: variance of a grey level.
        prior: information on α, and on β and γ, of the current planes, in 1 / q².
        samples: number of independent samples that a window counts for.
        weights: (S, n) float32 of the sources, if `weighted`.
        weighted: False: the better half of the sources counts, as the others may be occluded.
        steps: (n,) float32, written.
    """
    normal, right = np.empty(6), np.empty(3)
    held = np.empty(correlations.shape[0], np.float32)
    for i in range(steps.shape[0]):
        normal[:] = 0.0
        right[:] = 0.0
        normal[0], normal[3], normal[5] = prior[0], prior[1], prior[1]
        least = _F(_MIN_CORRELATION)
        if not weighted:
            least = max(least_of_best(correlations, i, held), least)
        for s in range(correlations.shape[0]):
            if correlations[s, i] >= least:
                count = samples * weights[s, i] if weighted else samples
                add_source(sums[s], i, np.float64(correlations[s, i]), variance[i], noise, count, normal, right)
        steps[i] = _F(solve_first(normal, right))


@kernel
def refine_rows(
    first_row: int,
    rows: int,
    planes: NDArray[np.float32],
    reference: Reference,
    sources: Sources,
    numbers: Numbers,
    weighted: bool,
    inverse: NDArray[np.float32],
    views: NDArray[np.float32],
) -> None:
    """Write the refined inverse ranges of some rows.

    Args:
        first_row: the first row.
        rows: number of rows.
        planes: (3, H, W) float32, the current planes, which are also the prior.
        reference: of the reference picture: (H + 2 pad, W + 2 pad) float32 grey, (2, W + 2 pad) float32 sin θ and cos θ
            of the columns, pad, (H,) columns per step in u, (side,) int64 rows of the window, (H, side) int64
            columns of the window.
        sources: see `sum_windows`.
        numbers: 1 / width in grey levels of the window's weights, noise, information of the prior on α, the same on β
            and γ, samples, maximum step in q.
        weighted: whether `views` holds weights; otherwise the better half of the sources counts.
        inverse: (H, W) float32, written.
        views: (S, H, W) float32 weights of the sources, replaced by their correlations; −2 where one does not count.
    """
    grey, azimuth, pad, stretches, window_rows, window_columns = reference
    color_scale, noise, prior_q, prior_slope, samples, largest = numbers
    _, height, width = planes.shape
    count, side = len(sources[1]), len(window_rows)
    prior, turned = (prior_q, prior_slope), sines_of_columns(width)
    for row in range(first_row, first_row + rows):
        elevation = elevation_from_y(row + 0.5, height)
        level, dip = np.cos(elevation), np.sin(elevation)
        for first in range(0, width, STRETCH):
            n = min(STRETCH, width - first)
            weights, centred = np.empty((side * side, n), np.float32), np.empty((side * side, n), np.float32)
            moments, sums = np.empty((2, n), np.float32), np.empty((count, SUMS, STRETCH), np.float32)
            votes, correlations = np.empty((count, n), np.bool_), np.empty((count, n), np.float32)
            steps, part = np.empty(n, np.float32), planes[:, row, first : first + n].copy()
            place = row, first, height, stretches[row], pad, window_rows, window_columns[row]
            weigh_window(grey, place, color_scale, weights, centred, moments)
            sum_windows(part, place, azimuth, (weights, centred, moments[0]), sources, sums, votes)
            correlate_sources(sums, votes, moments[1], noise, correlations)
            given = views[:, row, first : first + n].copy()
            most_likely_steps(sums, correlations, moments[1], noise, prior, samples, given, weighted, steps)
            views[:, row, first : first + n] = correlations
            for i in range(_U(n)):
                x = _U(first) + i
                q = part[0, i] * (level * turned[0, x]) + part[1, i] * -dip + part[2, i] * (level * turned[1, x])
                inverse[row, x] = max(q + min(max(steps[i], -largest), largest), q / 2)
