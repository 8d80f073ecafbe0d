"""Compiled: the costs of a band of rows in one source, at one depth hypothesis."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.costs.kernels_constants import CENSUS, CENSUS_GRADIENT, SAD_GRADIENT, ZNCC
from pano_mvs.algorithms.sweep.numba.kernels_census import count_census_row
from pano_mvs.algorithms.sweep.numba.kernels_cost import box_rows, difference_row
from pano_mvs.algorithms.sweep.numba.kernels_gradient import census_gradient_row, sad_gradient_row
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I32, I64, U8, U16, Sweep
from pano_mvs.algorithms.sweep.numba.kernels_warp import wrap_row
from pano_mvs.algorithms.sweep.numba.kernels_zncc import zncc_rows
from pano_mvs.core.kernels import kernel

_F = np.float32
_U = np.uint64


@kernel
def pixel_cost_row(
    cost: int,
    census_weight: int,
    reference: U8,
    reference_row: int,
    warped: U8,
    warped_row: int,
    offsets: I64,
    pad: int,
    disagree: U8,
    total: U16,
) -> None:
    """Write what each pixel of a row costs by itself. A new cost that is compiled has its branch here.

    Args:
        cost: which one, of `kernels_constants`.
        census_weight: of census beside grey levels.
        reference: (C, rows, W + 2 pad) uint8.
        reference_row: its row.
        warped: (C, rows, W + 2 pad) uint8, the source.
        warped_row: its row.
        offsets: (window,) int64 columns of the window in that row.
        pad: the margin.
        disagree: (W,) uint8, scratch.
        total: (W,) uint16, written.
    """
    if cost == CENSUS:
        count_census_row(reference[0], reference_row, warped[0], warped_row, offsets, pad, disagree)
        for i in range(_U(total.shape[0])):
            total[i] = np.uint16(disagree[i])
    elif cost == CENSUS_GRADIENT:
        census_gradient_row(
            reference[0], reference_row, warped[0], warped_row, offsets, census_weight, pad, disagree, total
        )
    elif cost == SAD_GRADIENT:
        sad_gradient_row(reference, reference_row, warped, warped_row, offsets[2], pad, total)
    else:
        total[:] = 0
        for c in range(reference.shape[0]):
            difference_row(reference[c], reference_row, warped[c], warped_row, pad, total)


@kernel
def source_cost(first: int, sweep: Sweep, warped: U8, pixel_costs: U16, scratch: I32, means: F32) -> None:
    """Compare a band of the reference with a warped source and average over the box.

    Args:
        first: the first row of the band.
        sweep: the reference, the windows and the cost.
        warped: (C, rows + 2 (compare_radius + box_radius), W + 2 pad) uint8.
        pixel_costs: (rows + 2 box_radius, W + 2 pad) uint16, scratch.
        scratch: (2, W + 2 pad) int32.
        means: (rows, W) float32, written.
    """
    rows, width = means.shape
    reference, cost, census_weight = sweep.reference, sweep.cost, sweep.census_weight
    window_offsets, all_reach, compare_radius, box_radius, pad = sweep.windows
    height = window_offsets.shape[0]
    reach = all_reach[first : first + rows]
    if cost == ZNCC:
        zncc_rows(first, reference[0], warped[0], reach, box_radius, pad, pixel_costs, scratch, means)
        return
    disagree = np.empty(width, np.uint8)
    for j in range(rows + 2 * box_radius):
        y = first - box_radius + j
        mirrored = -1 - y if y < 0 else (2 * height - 1 - y if y >= height else y)
        offsets = window_offsets[mirrored]
        compared = j + compare_radius
        total = pixel_costs[j, pad : pad + width]
        pixel_cost_row(cost, census_weight, reference, y + pad, warped, compared, offsets, pad, disagree, total)
        wrap_row(pixel_costs[j], width, pad)
    if box_radius:
        box_rows(pixel_costs, reach, box_radius, pad, scratch[0], scratch[1], means)
        return
    for j in range(_U(rows)):
        for i in range(_U(width)):
            means[j, i] = _F(pixel_costs[j, _U(pad) + i])


@kernel
def silence(votes: U8, halo: int, costs: F32) -> None:
    """Make costs, (rows, W), infinite where a source is not valid; `votes` has `halo` rows more on either side."""
    for j in range(costs.shape[0]):
        for i in range(_U(costs.shape[1])):
            costs[_U(j), i] = costs[_U(j), i] if votes[_U(j + halo), i] else _F(np.inf)


@kernel
def store_row(costs: F32, scale: float, voxels: U8) -> None:
    """Bring costs to the scale of the volume, 0 to 255, rounded; (W,) float32 to (W,) uint8."""
    for i in range(_U(costs.shape[0])):
        scaled = costs[i] * scale + _F(0.5)
        voxels[i] = np.uint8(np.int32(scaled if scaled < _F(255) else _F(255)))
