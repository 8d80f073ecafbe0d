"""Compiled: combine the costs of all sources at a pixel."""

from __future__ import annotations

import numpy as np
from numba import njit

from pano_mvs.algorithms.sweep.numba.kernels_records import F32, Combination

_F = np.float32
_U = np.uint64
# Sources hold the share that is asked for although their weights, added up, fall short of it by rounding.
ENOUGH = 1 - 1e-5


@njit(cache=True, error_model="numpy", nogil=True)
def combine_row(costs: F32, y: int, combination: Combination, picture_row: int, all_vote: bool, result: F32) -> None:
    """Combine the sources' costs of one row, infinite where a source is not valid.

    Sources are taken from the cheapest one on until they hold `share` of the weight of all valid ones, or are
    `max_count`; the result is the weighted mean of their costs.

    Args:
        costs: (S, rows, W) float32; sorted in place unless all sources count.
        y: the row in `costs`.
        combination: what counts.
        picture_row: the row in its weights.
        all_vote: that no cost is infinite.
        result: (W,) float32, written.
    """
    share, most, neutral = combination.share, combination.max_count, combination.neutral
    sources = costs.shape[0]
    if len(combination.weights):
        _combine_weighted(costs, y, combination, picture_row, result)
        return
    row = _U(y)
    used = min(most, int(np.ceil(share * ENOUGH * sources)))
    if used < sources:
        _sort_sources(costs, row)
    if all_vote:
        _mean_of_first(costs, row, used, result)
        return
    for i in range(_U(result.shape[0])):
        votes = 0
        for k in range(sources):
            votes += costs[_U(k), row, i] < np.inf
        used = min(most, int(np.ceil(share * ENOUGH * votes)))
        total = _F(0)
        taken = 0
        for k in range(sources):
            cost = costs[_U(k), row, i]
            if cost < np.inf and taken < used:
                total += cost
                taken += 1
        result[i] = total / _F(used) if used else neutral


@njit(cache=True, error_model="numpy", nogil=True)
def _sort_sources(costs: F32, row: int) -> None:
    """Sort the costs of one row over the sources, each pixel on its own."""
    for last in range(costs.shape[0] - 1, 0, -1):
        for k in range(last):
            a, b = _U(k), _U(k + 1)
            for i in range(_U(costs.shape[2])):
                p, q = costs[a, row, i], costs[b, row, i]
                costs[a, row, i] = p if p < q else q
                costs[b, row, i] = q if p < q else p


@njit(cache=True, error_model="numpy", nogil=True)
def _mean_of_first(costs: F32, row: int, used: int, result: F32) -> None:
    result[:] = _F(0)
    for k in range(used):
        for i in range(_U(result.shape[0])):
            result[i] += costs[_U(k), row, i]
    for i in range(_U(result.shape[0])):
        result[i] /= _F(used)


@njit(cache=True, error_model="numpy", nogil=True)
def _combine_weighted(costs: F32, y: int, combination: Combination, picture_row: int, result: F32) -> None:
    weights, share, most = combination.weights, combination.share, combination.max_count
    sources = costs.shape[0]
    row, weight_row = _U(y), _U(picture_row)
    own = np.empty(sources, np.float32)
    weight = np.empty(sources, np.float32)
    for i in range(_U(result.shape[0])):
        votes = 0
        total = _F(0)
        for k in range(sources):
            cost, heavy = costs[_U(k), row, i], weights[_U(k), weight_row, i]
            if cost < np.inf:
                total += heavy
                place = votes
                while place > 0 and own[place - 1] > cost:
                    own[place], weight[place] = own[place - 1], weight[place - 1]
                    place -= 1
                own[place], weight[place] = cost, heavy
                votes += 1
        held = combined = _F(0)
        taken = 0
        while taken < min(most, votes) and held < share * _F(ENOUGH) * total:
            combined += weight[taken] * own[taken]
            held += weight[taken]
            taken += 1
        result[i] = combined / held if taken else combination.neutral
