"""Compiled: the costs of a band of rows in one source at one depth hypothesis, and their means over boxes."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.kernels_constants import (
    CENSUS,
    CENSUS_GRADIENT,
    ENOUGH,
    GREY_WEIGHT,
    MAX_COLOR_COST,
    MAX_GRADIENT_COST,
    SAD_GRADIENT,
    ZNCC,
    ZNCC_NOISE_VARIANCE,
)
from pano_mvs.algorithms.sweep.numba.kernels_lookup import wrap_row
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I32, I64, U8, U16, U32, Combination, Sweep
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import CENSUS_PIXELS, HAS_VECTOR, census_block
from pano_mvs.core.kernels import inlined, kernel

_F = np.float32
_U = np.uint64


@kernel
def census_row(
    reference: U8, reference_row: int, warped: U8, warped_row: int, offsets: I64, pad: int, disagree: U8
) -> None:
    """Count the neighbours whose order against the centre differs between reference and warped source.

    `reference`: (rows, W + 2 pad) uint8 grey, wrapped. `reference_row`: row of the window's centre in `reference`.
    `warped`: likewise, the source. `warped_row`: row of the window's centre in `warped`. `offsets`: (window,) int64
    columns of the window against its centre. `pad`: width of the wrapped margin. `disagree`: (W,) uint8, written.
    """
    side = offsets.shape[0]
    width = _U(disagree.shape[0])
    middle = _U(pad)
    r0, w0 = _U(reference_row), _U(warped_row)
    disagree[:] = 0
    for j in range(side):
        r, w = _U(reference_row + j - side // 2), _U(warped_row + j - side // 2)
        for k in range(side):
            if j == side // 2 and k == side // 2:
                continue
            first = _U(pad + offsets[k])
            for i in range(width):
                differs = (reference[r, first + i] > reference[r0, middle + i]) != (
                    warped[w, first + i] > warped[w0, middle + i]
                )
                disagree[i] = np.uint8(disagree[i] + np.uint8(differs))


@kernel
def difference_row(reference: U8, reference_row: int, warped: U8, warped_row: int, pad: int, total: U16) -> None:
    """Add |reference − warped| of one row of one colour to `total`, (W,) uint16."""
    r, w, first = _U(reference_row), _U(warped_row), _U(pad)
    for i in range(_U(total.shape[0])):
        difference = np.int16(np.int16(reference[r, first + i]) - np.int16(warped[w, first + i]))
        total[i] = np.uint16(total[i] + np.uint16(abs(difference)))


@kernel
def average_row(column_sums: I32, reach: int, pad: int, share: np.float32, scratch: I32, means: F32) -> None:
    """Write sums of 2 reach + 1 neighbouring columns, times `share`; see `box_rows`."""
    sums, first = column_sums, _U(pad - reach)
    second, third, fourth, fifth = first + _U(1), first + _U(2), first + _U(3), first + _U(4)
    if reach == 1:  # sums can be vectorised, and running sums cannot
        for i in range(_U(means.shape[0])):
            means[i] = _F(np.int32(sums[first + i] + sums[second + i] + sums[third + i])) * share
        return
    if reach == 2:
        for i in range(_U(means.shape[0])):
            inner = np.int32(sums[second + i] + sums[third + i] + sums[fourth + i])
            means[i] = _F(np.int32(sums[first + i] + inner + sums[fifth + i])) * share
        return
    if reach == 3:
        sixth, seventh = first + _U(5), first + _U(6)
        for i in range(_U(means.shape[0])):
            inner = np.int32(sums[third + i] + sums[fourth + i] + sums[fifth + i])
            inner = np.int32(inner + sums[second + i] + sums[sixth + i])
            means[i] = _F(np.int32(sums[first + i] + inner + sums[seventh + i])) * share
        return
    left, right = first, _U(pad + reach)
    running = np.int32(0)
    for i in range(_U(column_sums.shape[0])):
        running = np.int32(running + column_sums[i])
        scratch[i] = running
    for i in range(_U(means.shape[0])):
        means[i] = _F(np.int32(scratch[right + i] - scratch[left - _U(1) + i])) * share


@kernel
def box_rows(pixel_costs: U16, reach: I64, radius: int, pad: int, column_sums: I32, prefix: I32, means: F32) -> None:
    """Average costs over windows of 2 radius + 1 rows by 2 reach + 1 columns, in O(1) each.

    `pixel_costs`: (rows + 2 radius, W + 2 pad) uint16, wrapped. `reach`: (rows,) int64 columns on either side, at most
    pad − 1, for each row. `radius`: rows on either side. `pad`: width of the wrapped margin. `column_sums`: (W + 2
    pad,) int32, scratch. `prefix`: (W + 2 pad,) int32, scratch. `means`: (rows, W) float32, written.
    """
    rows = means.shape[0]
    padded = _U(pixel_costs.shape[1])
    if radius == 1:
        for y in range(rows):
            above, here, below = _U(y), _U(y + 1), _U(y + 2)
            for i in range(padded):
                outer = np.int32(np.int32(pixel_costs[above, i]) + np.int32(pixel_costs[below, i]))
                column_sums[i] = np.int32(outer + np.int32(pixel_costs[here, i]))
            average_row(column_sums, reach[y], pad, _F(1.0 / (3 * (2 * reach[y] + 1))), prefix, means[y])
        return
    column_sums[:] = 0
    for j in range(2 * radius):
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] + np.int32(pixel_costs[_U(j), i]))
    for y in range(rows):
        entering, leaving = _U(y + 2 * radius), _U(y)
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] + np.int32(pixel_costs[entering, i]))
        share = _F(1.0 / ((2 * radius + 1) * (2 * reach[y] + 1)))
        average_row(column_sums, reach[y], pad, share, prefix, means[y])
        for i in range(padded):
            column_sums[i] = np.int32(column_sums[i] - np.int32(pixel_costs[leaving, i]))


@kernel
def count_census_row(
    reference: U8, reference_row: int, warped: U8, warped_row: int, offsets: I64, pad: int, disagree: U8
) -> None:
    """Do what `census_row` does, which shorter rows are left to. Both pictures must be as wide as each other."""
    width = disagree.shape[0]
    if not HAS_VECTOR or width < CENSUS_PIXELS:
        census_row(reference, reference_row, warped, warped_row, offsets, pad, disagree)
        return
    flat_reference, flat_warped = reference.reshape(-1), warped.reshape(-1)
    stride, side = reference.shape[1], offsets.shape[0]
    ours, theirs = reference_row * stride + pad, warped_row * stride + pad
    for i in range(0, width, CENSUS_PIXELS):
        at = min(i, width - CENSUS_PIXELS)  # the last block overlaps the one before it
        census_block(
            flat_reference, _U(ours + at), flat_warped, _U(theirs + at), _U(stride), offsets, _U(side), disagree, _U(at)
        )


_I = np.int16
_LARGEST_LEVEL, _LARGEST_GRADIENT = _I(MAX_COLOR_COST // 3), _I(MAX_GRADIENT_COST // 3)


@kernel
def gradient_row(
    reference: U8, reference_row: int, warped: U8, warped_row: int, reach: int, pad: int, total: U16
) -> None:
    """Add |∂x r − ∂x w| + |∂y r − ∂y w| of one row of one colour to `total`, (W,) uint16.

    Central differences, not halved: over two rows, and over `reach` columns on either side.
    """
    r, w = _U(reference_row), _U(warped_row)
    r_up, r_down = _U(reference_row - 1), _U(reference_row + 1)
    w_up, w_down = _U(warped_row - 1), _U(warped_row + 1)
    left, middle, right = _U(pad - reach), _U(pad), _U(pad + reach)
    for i in range(_U(total.shape[0])):
        across = np.int32(reference[r, right + i]) - np.int32(reference[r, left + i])
        across -= np.int32(warped[w, right + i]) - np.int32(warped[w, left + i])
        down = np.int32(reference[r_down, middle + i]) - np.int32(reference[r_up, middle + i])
        down -= np.int32(warped[w_down, middle + i]) - np.int32(warped[w_up, middle + i])
        total[i] = np.uint16(np.int32(total[i]) + abs(across) + abs(down))


@kernel
def sad_gradient_row(
    reference: U8, reference_row: int, warped: U8, warped_row: int, reach: int, pad: int, total: U16
) -> None:
    """Write the truncated differences of one row to `total`, (W,) uint16: of all colours, and of their gradients.

    `reference`: (C, rows, W + 2 pad) uint8, wrapped. `reference_row`: its row. `warped`: likewise, the source.
    `warped_row`: its row. `reach`: columns from a pixel to those of its horizontal gradient. `pad`: width of the
    wrapped margin. `total`: written.
    """
    gradient = np.zeros(total.shape[0], np.uint16)
    total[:] = 0
    for c in range(reference.shape[0]):
        difference_row(reference[c], reference_row, warped[c], warped_row, pad, total)
        gradient_row(reference[c], reference_row, warped[c], warped_row, reach, pad, gradient)
    for i in range(_U(total.shape[0])):
        color = min(np.int32(total[i]), np.int32(MAX_COLOR_COST))
        total[i] = np.uint16(color + min(np.int32(gradient[i]), np.int32(MAX_GRADIENT_COST)))


@kernel
def census_gradient_row(
    reference: U8,
    reference_row: int,
    warped: U8,
    warped_row: int,
    offsets: I64,
    census_weight: int,
    pad: int,
    disagree: U8,
    total: U16,
) -> None:
    """Write the census cost of one row, its weight times, plus that of grey levels and of their gradients.

    `reference`: (rows, W + 2 pad) uint8 grey, wrapped. `reference_row`: its row. `warped`: likewise, the source.
    `warped_row`: its row. `offsets`: (window,) int64 columns of the census window against its centre. `census_weight`:
    see `SweepSettings.census_weight`. `pad`: width of the wrapped margin. `disagree`: (W,) uint8, scratch. `total`:
    (W,) uint16, written.
    """
    count_census_row(reference, reference_row, warped, warped_row, offsets, pad, disagree)
    reach = offsets[offsets.shape[0] // 2 + 1]
    r, r_up, r_down = _U(reference_row), _U(reference_row - 1), _U(reference_row + 1)
    w, w_up, w_down = _U(warped_row), _U(warped_row - 1), _U(warped_row + 1)
    left, middle, right = _U(pad - reach), _U(pad), _U(pad + reach)
    for i in range(_U(total.shape[0])):  # everything in 16 bits, so that a register holds as many pixels as can be
        level = _step(reference[r, middle + i], warped[w, middle + i])
        across = _I(
            _step(reference[r, right + i], reference[r, left + i]) - _step(warped[w, right + i], warped[w, left + i])
        )
        down = _I(
            _step(reference[r_down, middle + i], reference[r_up, middle + i])
            - _step(warped[w_down, middle + i], warped[w_up, middle + i])
        )
        gradient = _I(max(across, _I(-across)) + max(down, _I(-down)))
        grey = _I(min(max(level, _I(-level)), _LARGEST_LEVEL) + min(gradient, _LARGEST_GRADIENT))
        census = np.uint16(np.uint16(census_weight) * np.uint16(disagree[i]))
        total[i] = np.uint16(census + np.uint16(np.uint16(GREY_WEIGHT) * np.uint16(grey)))


@inlined
def _step(a: np.uint8, b: np.uint8) -> np.int16:
    return _I(_I(a) - _I(b))


@kernel
def zncc_rows(
    first: int, reference: U8, warped: U8, reach: I64, radius: int, pad: int, products: U16, scratch: I32, means: F32
) -> None:
    """Write 1 − ρ of a band, ρ the correlation of reference and warped source over each pixel's window.

    ρ = cov(r, w) / √((var r + ν)(var w + ν)), ν the variance of noise: what is bare correlates with nothing.

    `first`: the first row of the band. `reference`: (H + 2 pad, W + 2 pad) uint8 grey, padded over seam and poles.
    `warped`: (rows + 2 radius, W + 2 pad) uint8. `reach`: (rows,) int64 columns of each row's window on either side.
    `radius`: rows of the window on either side. `pad`: the margin. `products`: (rows + 2 radius, W + 2 pad) uint16,
    scratch. `scratch`: (2, W + 2 pad) int32. `means`: (rows, W) float32, written.
    """
    rows, width = means.shape
    ours = reference[first + pad - radius : first + pad + radius + rows]
    sums = np.empty((4, rows, width), np.float32)
    pairs = ((ours, ours), (warped, warped), (ours, warped))
    for k in range(3):
        _multiply(pairs[k][0], pairs[k][1], products)
        box_rows(products, reach, radius, pad, scratch[0], scratch[1], sums[k])
    _copy(ours, products)
    box_rows(products, reach, radius, pad, scratch[0], scratch[1], sums[3])
    _copy(warped, products)
    box_rows(products, reach, radius, pad, scratch[0], scratch[1], means)
    noise = _F(ZNCC_NOISE_VARIANCE)
    for y in range(_U(rows)):
        for i in range(_U(width)):
            r, w = sums[3, y, i], means[y, i]
            var_r, var_w = max(sums[0, y, i] - r * r, _F(0)), max(sums[1, y, i] - w * w, _F(0))
            rho = (sums[2, y, i] - r * w) / np.sqrt((var_r + noise) * (var_w + noise))
            means[y, i] = _F(1) - min(max(rho, _F(-1)), _F(1))


@kernel
def _copy(one: U8, products: U16) -> None:
    for j in range(_U(products.shape[0])):
        for i in range(_U(products.shape[1])):
            products[j, i] = np.uint16(one[j, i])


@kernel
def _multiply(one: U8, other: U8, products: U16) -> None:
    for j in range(_U(products.shape[0])):
        for i in range(_U(products.shape[1])):
            products[j, i] = np.uint16(np.uint16(one[j, i]) * np.uint16(other[j, i]))


@inlined
def one_box_serves(sources: int, combination: Combination, box_radius: int, pad: int) -> bool:
    """Return whether the mean of all sources counts, whose differences can then be added before they are averaged.

    All sources must be valid everywhere. The sums have to fit uint16, and int32 in the widest box.
    """
    used = min(combination.max_count, int(np.ceil(combination.share * ENOUGH * sources)))
    largest = 3 * 255 * sources
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


@inlined
def divide_row(sums: F32, count: int, result: F32) -> None:
    """Write sums / count, both (W,) float32."""
    for i in range(_U(result.shape[0])):
        result[i] = sums[i] / _F(count)


@kernel
def pixel_cost_row(
    cost: int,
    others: bool | None,
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

    `cost`: which one, of `kernels_constants`. `others`: see `Sweep`. `census_weight`: of census beside grey levels.
    `reference`: (C, rows, W + 2 pad) uint8. `reference_row`: its row. `warped`: (C, rows, W + 2 pad) uint8, the source.
    `warped_row`: its row. `offsets`: (window,) int64 columns of the window in that row. `pad`: the margin. `disagree`:
    (W,) uint8, scratch. `total`: (W,) uint16, written.
    """
    if cost == CENSUS:
        count_census_row(reference[0], reference_row, warped[0], warped_row, offsets, pad, disagree)
        for i in range(_U(total.shape[0])):
            total[i] = np.uint16(disagree[i])
    elif cost == CENSUS_GRADIENT:
        census_gradient_row(
            reference[0], reference_row, warped[0], warped_row, offsets, census_weight, pad, disagree, total
        )
    elif others is not None and cost == SAD_GRADIENT:
        sad_gradient_row(reference, reference_row, warped, warped_row, offsets[2], pad, total)
    elif others is not None:
        total[:] = 0
        for c in range(reference.shape[0]):
            difference_row(reference[c], reference_row, warped[c], warped_row, pad, total)


@kernel
def source_cost(
    first: int, sweep: Sweep, others: bool | None, warped: U8, pixel_costs: U16, scratch: I32, means: F32
) -> None:
    """Compare a band of the reference with a warped source and average over the box.

    `first`: the first row of the band. `sweep`: the reference, the windows and the cost. `others`: its field. `warped`:
    (C, rows + 2 (compare_radius + box_radius), W + 2 pad) uint8. `pixel_costs`: (rows + 2 box_radius, W + 2 pad)
    uint16, scratch. `scratch`: (2, W + 2 pad) int32. `means`: (rows, W) float32, written.
    """
    rows, width = means.shape
    reference, cost, census_weight = sweep.reference, sweep.cost, sweep.census_weight
    window_offsets, all_reach, compare_radius, box_radius, pad = sweep.windows
    height = window_offsets.shape[0]
    reach = all_reach[first : first + rows]
    if others is not None and cost == ZNCC:
        zncc_rows(first, reference[0], warped[0], reach, box_radius, pad, pixel_costs, scratch, means)
        return
    disagree = np.empty(width, np.uint8)
    for j in range(rows + 2 * box_radius):
        y = first - box_radius + j
        mirrored = -1 - y if y < 0 else (2 * height - 1 - y if y >= height else y)
        offsets = window_offsets[mirrored]
        compared = j + compare_radius
        total = pixel_costs[j, pad : pad + width]
        pixel_cost_row(cost, others, census_weight, reference, y + pad, warped, compared, offsets, pad, disagree, total)
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
