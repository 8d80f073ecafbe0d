"""Compiled: all planes of one band of rows, from packed sources to costs."""

from __future__ import annotations

import numpy as np
from numba import njit

from pano_mvs.algorithms.sweep.numba.kernels_census import count_census_row
from pano_mvs.algorithms.sweep.numba.kernels_combine import combine_row
from pano_mvs.algorithms.sweep.numba.kernels_cost import (
    CENSUS,
    CENSUS_GRADIENT,
    SAD,
    SAD_GRADIENT,
    ZNCC,
    box_rows,
    difference_row,
)
from pano_mvs.algorithms.sweep.numba.kernels_gradient import census_gradient_row, sad_gradient_row
from pano_mvs.algorithms.sweep.numba.kernels_lookup import warp_band
from pano_mvs.algorithms.sweep.numba.kernels_project import knot_rows
from pano_mvs.algorithms.sweep.numba.kernels_sad import (
    add_differences,
    average_differences,
    divide_row,
    interleave_rows,
    one_box_serves,
)
from pano_mvs.algorithms.sweep.numba.kernels_warp import wrap_row
from pano_mvs.algorithms.sweep.numba.kernels_winner import PLANES_AT_ONCE, update_winners
from pano_mvs.algorithms.sweep.numba.kernels_zncc import zncc_rows
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import PIXELS

_F = np.float32
_U = np.uint64


@njit(cache=True, error_model="numpy", nogil=True)
def source_cost(  # type: ignore[no-untyped-def]
    first, reference, warped, offsets, reach, cost, census_weight, compare_radius, box_radius, pad, pixel_costs,
    scratch, means,
):  # fmt: skip
    """Compare a band of the reference with a warped source and average over the box.

    Args:
        first: the first row of the band.
        reference: (C, H + 2 pad, W + 2 pad) uint8, padded over seam and poles.
        warped: (C, rows + 2 (compare_radius + box_radius), W + 2 pad) uint8.
        offsets: (H, 2 compare_radius + 1) int64 columns of the window within which a pixel's cost looks around.
        reach: (H,) int64 columns of the box on either side.
        cost: which cost, see `kernels_cost`.
        census_weight: of census beside grey levels.
        compare_radius: rows on either side within which a pixel's cost looks around.
        box_radius: rows of the box on either side.
        pad: the margin.
        pixel_costs: (rows + 2 box_radius, W + 2 pad) uint16, scratch.
        scratch: (2, W + 2 pad) int32.
        means: (rows, W) float32, written.
    """
    rows, width = means.shape
    height = offsets.shape[0]
    if cost == ZNCC:
        zncc_rows(
            first, reference[0], warped[0], reach[first : first + rows], box_radius, pad, pixel_costs, scratch, means
        )
        return
    disagree = np.empty(width, np.uint8)
    total = np.empty(width, np.uint16)
    for j in range(rows + 2 * box_radius):
        y = first - box_radius + j
        mirrored = -1 - y if y < 0 else (2 * height - 1 - y if y >= height else y)
        if cost == CENSUS:
            count_census_row(reference[0], y + pad, warped[0], j + compare_radius, offsets[mirrored], pad, disagree)
            for i in range(_U(width)):
                total[i] = np.uint16(disagree[i])
        elif cost == CENSUS_GRADIENT:
            census_gradient_row(
                reference[0], y + pad, warped[0], j + compare_radius, offsets[mirrored], census_weight, pad, disagree,
                total,
            )  # fmt: skip
        elif cost == SAD_GRADIENT:
            sad_gradient_row(reference, y + pad, warped, j + compare_radius, offsets[mirrored, 2], pad, total)
        else:
            total[:] = 0
            for c in range(reference.shape[0]):
                difference_row(reference[c], y + pad, warped[c], j, pad, total)
        pixel_costs[j, pad : pad + width] = total
        wrap_row(pixel_costs[j], width, pad)
    if box_radius:
        box_rows(pixel_costs, reach[first : first + rows], box_radius, pad, scratch[0], scratch[1], means)
        return
    for j in range(_U(rows)):
        for i in range(_U(width)):
            means[j, i] = _F(pixel_costs[j, _U(pad) + i])


@njit(cache=True, error_model="numpy", nogil=True)
def store_row(costs, scale, voxels):  # type: ignore[no-untyped-def]
    """Bring costs to the scale of the volume, 0 to 255, rounded; (W,) float32 to (W,) uint8."""
    for i in range(_U(costs.shape[0])):
        scaled = costs[i] * scale + _F(0.5)
        voxels[i] = np.uint8(np.int32(scaled if scaled < _F(255) else _F(255)))


@njit(cache=True, error_model="numpy", nogil=True)
def _silence(votes, halo, costs):  # type: ignore[no-untyped-def]
    """Make costs, (rows, W), infinite where a source has no vote; `votes` has `halo` rows more on either side."""
    for j in range(costs.shape[0]):
        for i in range(costs.shape[1]):
            if votes[j + halo, i] == 0:
                costs[j, i] = np.inf


@njit(cache=True, error_model="numpy", nogil=True)
def sweep_band(  # type: ignore[no-untyped-def]
    first, reference, sin_cos_azimuth, poses, ranges, packed, colors, starts, shapes, valid, valid_starts, vector,
    offsets, reach, cost, census_weight, compare_radius, box_radius, pad, weights, share, most, scale, neutral, volume,
    state, planes,
):  # fmt: skip
    """Compute the costs of one band at all virtual ranges, into the volume or straight into the winners.

    Args:
        first: the first row of the band; it has as many rows as `planes`.
        reference: (C, H + 2 pad, W + 2 pad) uint8.
        sin_cos_azimuth: (2, W) float32.
        poses: (S, 3, 4) float64 source_from_reference.
        ranges: (D,) float64.
        packed: (·,) uint32, all sources, or empty.
        colors: (·,) uint64, all sources, or empty.
        starts: (S, ·) int64.
        shapes: (S, 2) int64.
        valid: (·,) uint8, or empty.
        valid_starts: (S,) int64.
        vector: whether to use vector instructions.
        offsets: (H, 2 compare_radius + 1) int64.
        reach: (H,) int64.
        cost: which cost.
        census_weight: of census beside grey levels.
        compare_radius: of the window of a pixel's cost.
        box_radius: of the box.
        pad: the margin, wider than every window reaches.
        weights: (S, H, W) float32, or empty; see `combine_row`.
        share: likewise.
        most: likewise.
        scale: float32 from mean costs to the volume's.
        neutral: float32 mean cost where no source votes.
        volume: (rows, D, W) uint8, the band's, written; empty if the winner is wanted at once.
        state: (STATES, rows, W) float32, infinite; see `update_plain`.
        planes: (rows, W) int32, written if the volume is empty.
    """
    rows, width = planes.shape
    sources, channels = starts.shape[0], reference.shape[0]
    halo = compare_radius + box_radius
    warped = np.empty((channels, rows + 2 * halo, width + 2 * pad), np.uint8)
    votes = np.empty((rows + 2 * halo, width), np.uint8)
    knots = np.empty((2, knot_rows(rows + 2 * halo), width), np.float32)
    pixel_costs = np.empty((rows + 2 * box_radius, width + 2 * pad), np.uint16)
    scratch = np.empty((2, width + 2 * pad), np.int32)
    costs = np.empty((sources, rows, width), np.float32)
    combined = np.empty((rows, PLANES_AT_ONCE, width), np.float32)
    summed = cost == SAD and len(valid) + len(weights) == 0 and one_box_serves(sources, share, most, box_radius, pad)
    above = first - halo + pad
    fused = cost == SAD and len(colors) > 0 and width % PIXELS == 0
    against = interleave_rows(reference, above, pixel_costs.shape[0] if fused else 0, pad)
    for d in range(len(ranges)):
        for s in range(sources):
            if s == 0 or not summed:
                pixel_costs[:] = 0
            warp_band(
                first - halo, offsets.shape[0], sin_cos_azimuth, poses[s], ranges[d], packed, colors, starts[s],
                shapes[s], valid, valid_starts[s], vector, pad, knots, warped, votes, against, pixel_costs,
            )  # fmt: skip
            if cost == SAD:
                if not fused:
                    add_differences(reference, above, warped, pad, pixel_costs)
                if s == sources - 1 or not summed:
                    average_differences(pixel_costs, reach[first : first + rows], box_radius, pad, scratch, costs[s])
            else:
                source_cost(
                    first, reference, warped, offsets, reach, cost, census_weight, compare_radius, box_radius, pad,
                    pixel_costs, scratch, costs[s],
                )  # fmt: skip
            if len(valid):
                _silence(votes, halo, costs[s])
        held = d % PLANES_AT_ONCE
        for j in range(rows):
            row = combined[j, held]
            if summed:
                divide_row(costs[sources - 1, j], sources, row)
            else:
                combine_row(costs, j, weights, first + j, share, most, len(valid) == 0, neutral, row)
            if len(volume):
                store_row(row, scale, volume[j, d])
            elif held == PLANES_AT_ONCE - 1 or d == len(ranges) - 1:
                update_winners(combined[j], 0, held + 1, d - held, state, j, planes)
