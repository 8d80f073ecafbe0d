"""Compiled: all planes of one band of rows, from packed sources to costs."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.costs.kernels_constants import SAD
from pano_mvs.algorithms.sweep.numba.kernels_combine import combine_row
from pano_mvs.algorithms.sweep.numba.kernels_lookup import warp_band
from pano_mvs.algorithms.sweep.numba.kernels_project import knot_rows
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, F64, I32, U8, Lookup, Sweep
from pano_mvs.algorithms.sweep.numba.kernels_sad import (
    add_differences,
    average_differences,
    divide_row,
    interleave_rows,
    one_box_serves,
)
from pano_mvs.algorithms.sweep.numba.kernels_source_cost import silence, source_cost, store_row
from pano_mvs.algorithms.sweep.numba.kernels_winner import PLANES_AT_ONCE, update_winners
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import PIXELS
from pano_mvs.core.kernels import kernel


@kernel
def sweep_band(first: int, sweep: Sweep, ranges: F64, volume: U8, state: F32, planes: I32) -> None:
    """Compute the costs of one band at all depth hypotheses, into the volume or straight into the winners.

    Args:
        first: the first row of the band; it has as many rows as `planes`.
        sweep: what all bands share.
        ranges: (D,) float64.
        volume: (rows, D, W) uint8, the band's, written; empty if the winner is wanted at once.
        state: (STATES, rows, W) float32, infinite; see `update_plain`.
        planes: (rows, W) int32, written if the volume is empty.
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
    against = interleave_rows(reference, above, pixel_costs.shape[0] if fused else 0, pad)
    found = Lookup(knots, warped, votes, against, pixel_costs)
    for d in range(len(ranges)):
        for s in range(count):
            if is_sad and (s == 0 or not summed):
                pixel_costs[:] = 0
            warp_band(first - halo, height, sin_cos_azimuth, sources, s, ranges[d], pad, found)
            if is_sad:
                if not fused:
                    add_differences(reference, above, warped, pad, pixel_costs)
                if s == count - 1 or not summed:
                    average_differences(pixel_costs, reach, box_radius, pad, scratch, costs[s])
            else:
                source_cost(first, sweep, warped, pixel_costs, scratch, costs[s])
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
