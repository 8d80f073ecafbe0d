"""Compiled: the most likely planes of the pixels of some rows, given the pictures and the planes so far."""

from __future__ import annotations

import numpy as np
from numba import njit

from pano_mvs.algorithms.patchmatch.kernels_match import (
    SUM_AB,
    SUM_B,
    SUM_BB,
    SUM_G,
    SUM_GA,
    SUM_GB,
    SUM_GG,
    SUMS,
    sum_windows,
    weigh_window,
)
from pano_mvs.algorithms.patchmatch.kernels_planes import tangent_basis

_F = np.float32
_U = np.uint64
# So many pixels of a row are computed together: their sums then fit the cache.
STRETCH = 256
# Windows that correlate less show different things.
_LEAST_CORRELATION = 0.2


@njit(cache=True, error_model="numpy", nogil=True)
def correlate_sources(sums, votes, variance, noise, correlations):  # type: ignore[no-untyped-def]
    """Write the correlation of each source with the reference, (S, n); −2 where it has no vote."""
    for s in range(correlations.shape[0]):
        for i in range(_U(correlations.shape[1])):
            b = sums[s, SUM_B, i]
            spread = sums[s, SUM_BB, i] - b * b + noise
            correlation = sums[s, SUM_AB, i] / np.sqrt(spread * (variance[i] + noise))
            correlations[s, i] = correlation if votes[s, i] else _F(-2)


@njit(cache=True, error_model="numpy", nogil=True)
def least_of_best(correlations, i, held):  # type: ignore[no-untyped-def]
    """Return the least correlation of the better half of the voting sources (rounded up); 1 if there is none."""
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


@njit(cache=True, error_model="numpy", nogil=True)
def add_source(sums, i, correlation, variance, noise, samples, normal, right):  # type: ignore[no-untyped-def]
    """Add what one source says of pixel i to the normal equations of (α, β, γ).

    With ã and b̃ the samples over their spread and J = ∂b̃ / ∂(α, β, γ), freed of its mean and of its part along b̃ (both
    are blind to brightness and contrast): Σ w J Jᵀ and Σ w J ã, over the variance of what b̃ leaves unexplained of ã.
    """
    mean = np.float64(sums[SUM_B, i])
    spread = sums[SUM_BB, i] - mean * mean + noise
    information = samples * spread / (noise + spread * (1 - correlation * correlation))
    both = np.sqrt(np.float64(variance + noise) * spread)
    along = ((sums[SUM_GB, i] - sums[SUM_G, i] * mean) / spread,
             (sums[SUM_GB + 1, i] - sums[SUM_G + 1, i] * mean) / spread,
             (sums[SUM_GB + 2, i] - sums[SUM_G + 2, i] * mean) / spread)  # fmt: skip
    entry = 0
    for a in range(3):
        right[a] += information * (sums[SUM_GA + a, i] / both - correlation * along[a])
        for b in range(a, 3):
            moment = sums[SUM_GG + entry, i] - np.float64(sums[SUM_G + a, i]) * sums[SUM_G + b, i]
            normal[entry] += information * (moment / spread - along[a] * along[b])
            entry += 1


@njit(cache=True, error_model="numpy", nogil=True)
def solve_first(a, b):  # type: ignore[no-untyped-def]
    """Return the first unknown of a positive definite 3×3 system, a = (xx, xy, xz, yy, yz, zz)."""
    c00, c01, c02 = a[3] * a[5] - a[4] * a[4], a[2] * a[4] - a[1] * a[5], a[1] * a[4] - a[2] * a[3]
    determinant = a[0] * c00 + a[1] * c01 + a[2] * c02
    return (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant


@njit(cache=True, error_model="numpy", nogil=True)
def most_likely_steps(sums, correlations, variance, noise, prior, samples, steps):  # type: ignore[no-untyped-def]
    """Write the step of α, (n,), that is most likely given the pictures and the planes so far.

    Args:
        sums: (S, SUMS, n) float32 of the windows, see `sum_windows`.
        correlations: (S, n) float32; the better half of the sources counts, for the others may be hidden.
        variance: (n,) float32 of the reference's windows.
        noise: variance of a grey level.
        prior: (2,) information on α, and on β and γ, of the planes so far, in 1 / q².
        samples: how many independent samples a window counts for.
        steps: (n,) float32, written.
    """
    normal, right = np.empty(6), np.empty(3)
    held = np.empty(correlations.shape[0], np.float32)
    for i in range(steps.shape[0]):
        normal[:] = 0.0
        right[:] = 0.0
        normal[0], normal[3], normal[5] = prior[0], prior[1], prior[1]
        least = max(least_of_best(correlations, i, held), _F(_LEAST_CORRELATION))
        for s in range(correlations.shape[0]):
            if correlations[s, i] >= least:
                add_source(sums[s], i, np.float64(correlations[s, i]), variance[i], noise, samples, normal, right)
        steps[i] = _F(solve_first(normal, right))


@njit(cache=True, error_model="numpy", nogil=True)
def refine_rows(first_row, rows, planes, reference, sources, numbers, inverse):  # type: ignore[no-untyped-def]
    """Write the refined inverse ranges of some rows.

    Args:
        first_row: the first row.
        rows: how many.
        planes: (3, H, W) float32, the planes so far, which are also the prior.
        reference: of the reference picture: (H + 2 pad, W + 2 pad) float32 grey, (2, W + 2 pad) float32 sin θ and cos θ
            of the columns, pad, (H,) columns that make a step in u, (side,) int64 rows of the window, (H, side) int64
            columns of the window.
        sources: see `sum_windows`.
        numbers: 1 / width in grey levels of the window's weights, noise, information of the prior on α, the same on β
            and γ, samples, largest step in q.
        inverse: (H, W) float32, written.
    """
    grey, azimuth, pad, stretches, window_rows, window_columns = reference
    color_scale, noise, prior_q, prior_slope, samples, largest = numbers
    _, height, width = planes.shape
    count, side = len(sources[1]), len(window_rows)
    prior, basis = (prior_q, prior_slope), np.empty((3, 3))
    for row in range(first_row, first_row + rows):
        for first in range(0, width, STRETCH):
            n = min(STRETCH, width - first)
            weights, centred = np.empty((side * side, n), np.float32), np.empty((side * side, n), np.float32)
            moments, sums = np.empty((2, n), np.float32), np.empty((count, SUMS, n), np.float32)
            votes, correlations = np.empty((count, n), np.bool_), np.empty((count, n), np.float32)
            steps, part = np.empty(n, np.float32), planes[:, row, first : first + n].copy()
            place = row, first, height, stretches[row], pad, window_rows, window_columns[row]
            weigh_window(grey, place, color_scale, weights, centred, moments)
            sum_windows(part, place, azimuth, (weights, centred, moments[0]), sources, sums, votes)
            correlate_sources(sums, votes, moments[1], noise, correlations)
            most_likely_steps(sums, correlations, moments[1], noise, prior, samples, steps)
            for i in range(n):
                tangent_basis(row, first + i, height, width, 1.0, basis)
                q = part[0, i] * basis[0, 0] + part[1, i] * basis[0, 1] + part[2, i] * basis[0, 2]
                inverse[row, first + i] = max(q + min(max(steps[i], -largest), largest), q / 2)
