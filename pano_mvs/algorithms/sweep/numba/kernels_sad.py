"""Compiled: sums of absolute differences of R, G and B of a band of rows."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_combine import ENOUGH
from pano_mvs.algorithms.sweep.numba.kernels_cost import box_rows, difference_row
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I32, I64, U8, U16, U32, U64, Combination
from pano_mvs.algorithms.sweep.numba.kernels_warp import wrap_row
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR, PIXELS, difference_rgb_block
from pano_mvs.core.kernels import kernel

_F = np.float32
_U = np.uint64
_MAX_DIFFERENCE = 3 * 255


@kernel
def one_box_serves(sources: int, combination: Combination, box_radius: int, pad: int) -> bool:
    """Return whether the mean of all sources counts, whose differences can then be added before they are averaged.

    All sources must be valid everywhere. The sums have to fit uint16, and int32 in the widest box.
    """
    used = min(combination.max_count, int(np.ceil(combination.share * ENOUGH * sources)))
    largest = _MAX_DIFFERENCE * sources
    fits = largest < 1 << 16 and largest * (2 * box_radius + 1) * (2 * pad + 1) < 1 << 31
    return len(combination.weights) == 0 and used == sources and fits


@kernel
def interleave_rows(reference: U8, first: int, rows: int, pad: int) -> U32:
    """Return rows `first` … of (3, H + 2 pad, W + 2 pad) uint8, without the margin, as R | G << 8 | B << 16."""
    width = reference.shape[2] - 2 * pad
    pixels = np.zeros((rows, width), np.uint32)
    for j in range(rows):
        for c in range(3):
            for i in range(width):
                pixels[j, i] |= np.uint32(reference[c, first + j, pad + i]) << np.uint32(8 * c)
    return pixels


@kernel
def add_sampled_differences(
    colors: U64,
    start: int,
    index: I32,
    weight_y: I32,
    weight_x: I32,
    reference: U32,
    row: int,
    pad: int,
    pixel_costs: U16,
) -> None:
    """Sample a row by vector instructions and add its differences from the reference; W must be whole blocks.

    Args:
        colors: (·,) uint64 `pack_colors`.
        start: where the source begins.
        index: (W,) int32, see `place_row`.
        weight_y: (W,) int32.
        weight_x: (W,) int32.
        reference: (rows, W) uint32 of `interleave_rows`.
        row: the row of the reference and of the costs.
        pad: width of the margin of the costs.
        pixel_costs: (rows, W + 2 pad) uint16, added to.
    """
    base, width = _U(start), reference.shape[1]
    ours, costs = row * width, row * pixel_costs.shape[1] + pad
    if HAS_VECTOR:  # a constant: without it the block is not compiled, which is impossible on other processors
        for i in range(0, width, PIXELS):
            difference_rgb_block(
                colors, base, index, weight_y, weight_x, _U(i), reference, _U(ours + i), pixel_costs, _U(costs + i)
            )


@kernel
def add_differences(reference: U8, first: int, warped: U8, pad: int, pixel_costs: U16) -> None:
    """Add what a warped source, (C, rows, W + 2 pad) uint8, differs by from the reference's rows `first` …."""
    width = pixel_costs.shape[1] - 2 * pad
    for j in range(pixel_costs.shape[0]):
        for c in range(reference.shape[0]):
            difference_row(reference[c], first + j, warped[c], j, pad, pixel_costs[j, pad : pad + width])


@kernel
def average_differences(pixel_costs: U16, reach: I64, radius: int, pad: int, scratch: I32, means: F32) -> None:
    """Average costs over the box; the margins of `pixel_costs` are written first. See `box_rows`."""
    for j in range(pixel_costs.shape[0]):
        wrap_row(pixel_costs[j], means.shape[1], pad)
    if radius:
        box_rows(pixel_costs, reach, radius, pad, scratch[0], scratch[1], means)
        return
    for j in range(_U(means.shape[0])):
        for i in range(_U(means.shape[1])):
            means[j, i] = _F(pixel_costs[j, _U(pad) + i])


@kernel
def divide_row(sums: F32, count: int, result: F32) -> None:
    """Write sums / count, both (W,) float32."""
    for i in range(_U(result.shape[0])):
        result[i] = sums[i] / _F(count)
