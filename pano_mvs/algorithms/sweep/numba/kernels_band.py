"""Compiled: all planes of one band of rows, from packed sources to the combined costs of all sources."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.kernels_constants import ENOUGH, SAD
from pano_mvs.algorithms.sweep.numba.kernels_cost import (
    add_differences,
    average_differences,
    divide_row,
    interleave_rows,
    one_box_serves,
    silence,
    source_cost,
    store_row,
)
from pano_mvs.algorithms.sweep.numba.kernels_lookup import knot_rows, warp_band
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, F64, I32, U8, Combination, Lookup, Sweep
from pano_mvs.algorithms.sweep.numba.kernels_winner import PLANES_AT_ONCE, update_winners
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import PIXELS
from pano_mvs.core.kernels import inlined, kernel

_F = np.float32
_U = np.uint64
# `_combine_few` combines at most this many sources, of which at most half count, and this many pixels at a time.
_FEW, _BLOCK = 8, 256


@kernel
def combine_row(costs: F32, y: int, combination: Combination, picture_row: int, all_vote: bool, result: F32) -> None:
    """Combine the sources' costs of one row, infinite where a source is not valid.

    Sources are taken from the cheapest one on until they hold `share` of the weight of all valid ones, or are
    `max_count`; the result is the weighted mean of their costs.

    `costs`: (S, rows, W) float32; sorted in place unless all sources count. `y`: the row in `costs`. `combination`:
    what counts. `picture_row`: the row in its weights. `all_vote`: that no cost is infinite. `result`: (W,) float32,
    written.
    """
    share, most, neutral = combination.share, combination.max_count, combination.neutral
    sources = costs.shape[0]
    if len(combination.weights):
        _combine_weighted(costs, y, combination, picture_row, result)
        return
    row = _U(y)
    used = min(most, int(np.ceil(share * ENOUGH * sources)))
    if sources <= _FEW and 2 * used <= _FEW:
        _combine_few(costs, row, share, most, neutral, result)
        return
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


@inlined
def _in_order(a: np.float32, b: np.float32) -> tuple[np.float32, np.float32]:
    return (a, b) if a < b else (b, a)


@kernel
def _mean_of_cheapest(
    held: NDArray[np.float32], share: float, most: int, neutral: np.float32, result: NDArray[np.float32]
) -> None:
    """Combine the costs of up to eight sources, of which at most four count, in a loop without branches.

    `held`: (8 · 256,) float32, source after source, infinite for sources that are not valid or do not exist. `share`:
    of the valid sources that count. `most`: number of sources that count. `neutral`: the cost without a valid source.
    `result`: (n,) float32, written.
    """
    block, one, none = _U(_BLOCK), np.int32(1), np.int32(0)
    for i in range(_U(result.shape[0])):
        a, b, c, d = held[i], held[i + block], held[i + _U(2) * block], held[i + _U(3) * block]
        e, f = held[i + _U(4) * block], held[i + _U(5) * block]
        g, h = held[i + _U(6) * block], held[i + _U(7) * block]
        votes = (one if a < np.inf else none) + (one if b < np.inf else none) + (one if c < np.inf else none)
        votes += (one if d < np.inf else none) + (one if e < np.inf else none) + (one if f < np.inf else none)
        votes += (one if g < np.inf else none) + (one if h < np.inf else none)
        used = np.ceil(share * ENOUGH * votes)
        used = used if used < most else np.float64(most)
        # Two fours in order; the lesser ones of both, from either end, are the four least; these in order.
        a, b = _in_order(a, b)
        c, d = _in_order(c, d)
        a, c = _in_order(a, c)
        b, d = _in_order(b, d)
        b, c = _in_order(b, c)
        e, f = _in_order(e, f)
        g, h = _in_order(g, h)
        e, g = _in_order(e, g)
        f, h = _in_order(f, h)
        f, g = _in_order(f, g)
        a, b = h if h < a else a, g if g < b else b
        c, d = f if f < c else c, e if e < d else d
        a, c = _in_order(a, c)
        b, d = _in_order(b, d)
        a, b = _in_order(a, b)
        c, d = _in_order(c, d)
        total = (a if used > 0.5 else _F(0)) + (b if used > 1.5 else _F(0))
        total = total + (c if used > 2.5 else _F(0))
        total = total + (d if used > 3.5 else _F(0))
        result[i] = total / _F(used) if used > 0.5 else neutral


@kernel
def _combine_few(costs: F32, row: int, share: float, most: int, neutral: np.float32, result: F32) -> None:
    """Do what `combine_row` does for up to eight sources without weights, of which at most four count."""
    held = np.full(_FEW * _BLOCK, np.inf, np.float32)
    for first in range(0, result.shape[0], _BLOCK):
        count = min(_BLOCK, result.shape[0] - first)
        for k in range(costs.shape[0]):
            start, of_block = _U(k * _BLOCK), _U(first)
            for i in range(_U(count)):
                held[start + i] = costs[_U(k), row, of_block + i]
        _mean_of_cheapest(held, share, most, neutral, result[first : first + count])


@kernel
def _sort_sources(costs: F32, row: int) -> None:
    """Sort the costs of one row over the sources, each pixel on its own."""
    for last in range(costs.shape[0] - 1, 0, -1):
        for k in range(last):
            a, b = _U(k), _U(k + 1)
            for i in range(_U(costs.shape[2])):
                p, q = costs[a, row, i], costs[b, row, i]
                costs[a, row, i] = p if p < q else q
                costs[b, row, i] = q if p < q else p


@kernel
def _mean_of_first(costs: F32, row: int, used: int, result: F32) -> None:
    result[:] = _F(0)
    for k in range(used):
        for i in range(_U(result.shape[0])):
            result[i] += costs[_U(k), row, i]
    for i in range(_U(result.shape[0])):
        result[i] /= _F(used)


@kernel
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


@kernel
def sweep_band(first: int, sweep: Sweep, others: bool | None, ranges: F64, volume: U8, state: F32, planes: I32) -> None:
    """Compute the costs of one band at all depth hypotheses, into the volume or straight into the winners.

    `first`: the first row of the band; it has as many rows as `planes`. `sweep`: what all bands share. `others`: its
    field. `ranges`: (D,) float64. `volume`: (rows, D, W) uint8, the band's, written; empty if the winner is wanted at
    once. `state`: (STATES, rows, W) float32, infinite; see `update_plain`. `planes`: (rows, W) int32, written if the
    volume is empty.
    """
    rows, width = planes.shape
    sources, windows, combination, reference = sweep.sources, sweep.windows, sweep.combination, sweep.reference
    sin_cos_azimuth, scale, is_sad = sweep.sin_cos_azimuth, sweep.scale, sweep.cost == SAD
    count, pad, box_radius = sources.starts.shape[0], windows.pad, windows.box_radius
    halo, height = windows.compare_radius + box_radius, windows.offsets.shape[0]
    reach = windows.reach[first : first + rows]
    all_vote = len(sources.valid) == 0
    warped = np.empty((reference.shape[0], rows + 2 * halo, width + 2 * pad), np.uint8)
    votes = np.empty((rows + 2 * halo, width), np.uint8)
    knots = np.empty((2, knot_rows(rows + 2 * halo), width), np.float32)
    pixel_costs = np.empty((rows + 2 * box_radius, width + 2 * pad), np.uint16)
    scratch = np.empty((2, width + 2 * pad), np.int32)
    costs = np.empty((count, rows, width), np.float32)
    combined = np.empty((rows, PLANES_AT_ONCE, width), np.float32)
    summed = is_sad and all_vote and one_box_serves(count, combination, box_radius, pad)
    above = first - halo + pad
    fused = is_sad and len(sources.colors) > 0 and width % PIXELS == 0
    against = np.empty((0, width), np.uint32)
    if others is not None and fused:
        against = interleave_rows(reference, above, pixel_costs.shape[0], pad)
    found = Lookup(knots, warped, votes, against, pixel_costs)
    for d in range(len(ranges)):
        for s in range(count):
            if is_sad and (s == 0 or not summed):
                pixel_costs[:] = 0
            warp_band(first - halo, height, sin_cos_azimuth, sources, s, others, ranges[d], pad, found)
            if others is not None and is_sad:
                if not fused:
                    add_differences(reference, above, warped, pad, pixel_costs)
                if s == count - 1 or not summed:
                    average_differences(pixel_costs, reach, box_radius, pad, scratch, costs[s])
            else:
                source_cost(first, sweep, others, warped, pixel_costs, scratch, costs[s])
            if sources.masked[s, 0] < sources.masked[s, 1]:
                silence(votes, halo, costs[s])
        held = d % PLANES_AT_ONCE
        for j in range(rows):
            row = combined[j, held]
            if summed:
                divide_row(costs[count - 1, j], count, row)
            else:
                combine_row(costs, j, combination, first + j, all_vote, row)
            if len(volume):
                store_row(row, scale, volume[j, d])
            elif held == PLANES_AT_ONCE - 1 or d == len(ranges) - 1:
                update_winners(combined[j], 0, held + 1, d - held, state, j, planes)
