"""Compiled: sample one source for a band of rows of the reference at one depth hypothesis.

A band is projected exactly in every eighth row and by cubic interpolation between; low pictures, where eight rows are a
large step on the sphere, are projected exactly in all rows. The exact position costs two arc tangents. Along a column
of the reference it is smooth but near the poles of the source: there, where four exact rows are bent too much (their
third difference is large, and with it the fourth, of which a cubic between them misses 0.023), it is computed exactly.
Rows, not columns, are skipped: a rolled picture then has the same positions, and the inner loops have no border.

Rows are computed in short separate loops (project, gather, blend) over arrays of one row: a loop that both gathers and
stores cannot be proved free of aliasing, and is then not vectorised. Loop variables are unsigned, since numba checks
signed ones for negative indices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.kernels_constants import HALFWAY_ROUND, HALFWAY_SHIFT, ROUND, SHIFT, UNIT
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, F64, I32, I64, U8, U16, U32, U64, Lookup, Sources
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import (
    HAS_VECTOR,
    PIXELS,
    blend_grey_block,
    difference_rgb_block,
    sample_rgb_block,
)
from pano_mvs.core.kernels import inlined, kernel
from pano_mvs.geometry.kernels_sphere import fast_azimuth, fast_dip

_F = np.float32
_U = np.uint64
_HALF = _F(0.5)


@kernel
def project_row(
    sin_cos_azimuth: F32, matrix: F32, offset: F32, shape: I64, start: int, stop: int, x_px: F32, y_px: F32
) -> None:
    """Find where the columns `start` … `stop` − 1 of a row of rays, of azimuth θ, arrive in a packed source.

    `sin_cos_azimuth`: (2, W) float32 sin θ and cos θ. `matrix`: (3, 2) float32: x_in_source = matrix @ (sin θ, cos θ) +
    offset, of any positive length. `offset`: (3,) float32. `shape`: (2,) int64 rows and columns of the source picture.
    `start`: the first column. `stop`: the column after the last. `x_px`: (W,) float32, written: ½ to columns + ½, the
    position among the packed patches. `y_px`: (W,) float32, written: ½ to rows + ½.
    """
    m00, m01, o0 = matrix[0, 0], matrix[0, 1], offset[0]
    m10, m11, o1 = matrix[1, 0], matrix[1, 1], offset[1]
    m20, m21, o2 = matrix[2, 0], matrix[2, 1], offset[2]
    x_scale, y_scale = _F(shape[1] / (2 * np.pi)), _F(shape[0] / np.pi)
    x_middle, y_middle = _F(shape[1] / 2 + 0.5), _F(shape[0] / 2 + 0.5)
    for i in range(_U(start), _U(stop)):
        s, c = sin_cos_azimuth[0, i], sin_cos_azimuth[1, i]
        x = m00 * s + m01 * c + o0
        y = m10 * s + m11 * c + o1
        z = m20 * s + m21 * c + o2
        x_px[i] = fast_azimuth(x, z) * x_scale + x_middle
        y_px[i] = fast_dip(y, np.sqrt(x * x + z * z)) * y_scale + y_middle


@kernel
def place_row(x_px: F32, y_px: F32, shape: I64, index: I32, weight_x: I32, weight_y: I32) -> None:
    """Turn positions among packed patches into an index and integer weights.

    `x_px`: (W,) float32, less than one turn away from where `project_row` puts it. `y_px`: (W,) float32. `shape`: (2,)
    int64 of the source picture. `index`: (W,) int32, written: of the patch, in rows of columns + 2. `weight_x`: (W,)
    int32, written: two words, left and right, of 16384 in all. `weight_y`: (W,) int32, written: likewise upper and
    lower.
    """
    turn, least, last = _F(shape[1]), _HALF, _F(shape[1] + 0.5)
    stride = np.int32(shape[1] + 2)
    last_row, last_column = np.int32(shape[0]), np.int32(shape[1])
    for i in range(_U(index.shape[0])):
        x, y = x_px[i], y_px[i]
        x = x + turn if x < least else x
        x = x - turn if x >= last else x
        column, row = np.int32(x), np.int32(y)
        column = min(max(column, np.int32(0)), last_column)
        row = min(max(row, np.int32(0)), last_row)
        right = np.int32((x - _F(column)) * _F(UNIT) + _HALF)
        lower = np.int32((y - _F(row)) * _F(UNIT) + _HALF)
        index[i] = np.int32(row * stride + column)
        weight_x[i] = np.int32(np.int32(UNIT) + right * np.int32(65535))
        weight_y[i] = np.int32(np.int32(UNIT) + lower * np.int32(65535))


@kernel
def gather_row(packed: U32, start: int, index: I32, patches: U32) -> None:
    """Fetch the 2×2 patches, packed as four bytes, at `start + index`; all (W,) but `packed`."""
    base = _U(start)
    for i in range(_U(index.shape[0])):
        patches[i] = packed[base + _U(index[i])]


@kernel
def blend_row(patches: U32, weight_x: I32, weight_y: I32, out: U8, out_at: int) -> None:
    """Blend 2×2 patches bilinearly into `out[out_at:out_at + W]`, uint8, rounded.

    A patch holds values less 128 in four signed bytes, upper left, lower left, upper right and lower right. Weights are
    in 1/16384; between rows and columns there are 8 bits behind the point.
    """
    word = np.int32(65535)
    for i in range(_U(patches.shape[0])):
        patch, across, down = np.int32(patches[i]), weight_x[i], weight_y[i]
        upper, lower = np.int32(down & word), np.int32(down >> np.int32(16))
        upper_left = np.int32(np.int32(patch << np.int32(24)) >> np.int32(24))
        lower_left = np.int32(np.int32(patch << np.int32(16)) >> np.int32(24))
        upper_right = np.int32(np.int32(patch << np.int32(8)) >> np.int32(24))
        lower_right = np.int32(patch >> np.int32(24))
        left = np.int32(upper * upper_left + lower * lower_left + np.int32(HALFWAY_ROUND))
        right = np.int32(upper * upper_right + lower * lower_right + np.int32(HALFWAY_ROUND))
        left, right = np.int32(left >> np.int32(HALFWAY_SHIFT)), np.int32(right >> np.int32(HALFWAY_SHIFT))
        blended = np.int32(left * np.int32(across & word) + right * np.int32(across >> np.int32(16)))
        blended = np.int32(np.int32(blended + np.int32(ROUND)) >> np.int32(SHIFT))
        out[_U(out_at) + i] = np.uint8(blended + np.int32(128))


@kernel
def wrap_row(row: NDArray[Any], width: int, pad: int) -> None:
    """Fill the `pad` entries on either side of `row[pad:pad + width]` over the seam."""
    for i in range(pad):
        row[i] = row[width + i]
        row[pad + width + i] = row[pad + i]


EVERY = 8
"""Rows from one exact row to the next."""

INTERPOLATED_FROM = 128
"""Pictures with fewer rows than these are projected exactly in all of them."""

_BLOCK = 16


@kernel
def ray_row(y: int, height: int, pose: F64, virtual_range: float, matrix: F32, offset: F32) -> None:
    """Compute what takes (sin θ, cos θ) of row y, which may lie beyond a pole, into the source; see `project_row`."""
    elevation = np.pi * (0.5 - (y + 0.5) / height)
    level, dip = np.cos(elevation), -np.sin(elevation)
    for a in range(3):
        matrix[a, 0] = _F(level * pose[a, 0])
        matrix[a, 1] = _F(level * pose[a, 2])
        offset[a] = _F(dip * pose[a, 1] + pose[a, 3] / virtual_range)


@inlined
def _across(step: np.float32, turn: np.float32) -> np.float32:
    """Return a difference of columns the short way around."""
    half = _F(turn * _F(0.5))
    step = step - turn if step > half else step
    return step + turn if step < -half else step


@kernel
def fit_group(knots: F32, first: int, turn: np.float32, curve: F32, rough: U8) -> None:
    """Fit cubics through the exact rows `first` to `first` + 3, and see where they are too bent for that.

    `knots`: (2, K, W) float32 x and y of the exact rows. `first`: of them. `turn`: columns of the source, float32.
    `curve`: (2, 3, W) float32, written: first, second and third differences of x and of y. `rough`: (W,) uint8,
    written: whether the cubic misses.
    """
    k, one, two, three = _U(first), _U(first + 1), _U(first + 2), _U(first + 3)
    largest = _F(1)
    for i in range(_U(rough.shape[0])):
        step = _across(knots[0, one, i] - knots[0, k, i], turn)
        after = _across(knots[0, two, i] - knots[0, one, i], turn)
        last = _across(knots[0, three, i] - knots[0, two, i], turn)
        curve[0, 0, i] = step
        curve[0, 1, i] = after - step
        curve[0, 2, i] = (last - after) - (after - step)
    for i in range(_U(rough.shape[0])):
        step = knots[1, one, i] - knots[1, k, i]
        after = knots[1, two, i] - knots[1, one, i]
        last = knots[1, three, i] - knots[1, two, i]
        curve[1, 0, i] = step
        curve[1, 1, i] = after - step
        curve[1, 2, i] = (last - after) - (after - step)
    for i in range(_U(rough.shape[0])):
        rough[i] = np.uint8((abs(curve[0, 2, i]) > largest) | (abs(curve[1, 2, i]) > largest))


@kernel
def rough_runs(rough: U8, runs: I64) -> int:
    """Write the runs of blocks of columns that need exact positions, (·, 2) int64 start and stop; return how many."""
    width = rough.shape[0]
    count = 0
    for start in range(0, width, _BLOCK):
        stop = min(start + _BLOCK, width)
        found = np.int32(0)
        for i in range(_U(start), _U(stop)):
            found += np.int32(rough[i])
        if not found:
            continue
        if count and runs[count - 1, 1] == start:
            runs[count - 1, 1] = stop
            continue
        runs[count, 0], runs[count, 1] = start, stop
        count += 1
    return count


@kernel
def replace_rough(rough: U8, exact: F32, start: int, stop: int, x_px: F32, y_px: F32) -> None:
    """Take the exact positions, (2, W), of the rough columns, and of no others: blocks must not show in the result."""
    for i in range(_U(start), _U(stop)):
        x_px[i] = exact[0, i] if rough[i] else x_px[i]
        y_px[i] = exact[1, i] if rough[i] else y_px[i]


@kernel
def follow_curve(knots: F32, first: int, curve: F32, step: float, x_px: F32, y_px: F32) -> None:
    """Evaluate the cubics `step` exact rows after `first`, at most 3; writes x_px and y_px, (W,) float32."""
    k = _U(first)
    t = _F(step)
    u = _F(step * (step - 1) / 2)
    v = _F(step * (step - 1) * (step - 2) / 6)
    for i in range(_U(x_px.shape[0])):
        x_px[i] = knots[0, k, i] + t * curve[0, 0, i] + u * curve[0, 1, i] + v * curve[0, 2, i]
    for i in range(_U(x_px.shape[0])):
        y_px[i] = knots[1, k, i] + t * curve[1, 0, i] + u * curve[1, 1, i] + v * curve[1, 2, i]


@inlined
def knot_rows(rows: int) -> int:
    """Return how many exact rows a band of `rows` needs; at least four."""
    return max(-(-(rows - 1) // EVERY) + 1, 4)


@kernel
def project_knots(
    first: int, height: int, sin_cos_azimuth: F32, pose: F64, virtual_range: float, shape: I64, knots: F32
) -> None:
    """Compute every eighth row from `first` exactly, into (2, K, W) float32."""
    matrix = np.empty((3, 2), np.float32)
    offset = np.empty(3, np.float32)
    for k in range(knots.shape[1]):
        ray_row(first + k * EVERY, height, pose, virtual_range, matrix, offset)
        project_row(sin_cos_azimuth, matrix, offset, shape, 0, knots.shape[2], knots[0, k], knots[1, k])


@kernel
def _sample_planes(
    packed: U32,
    starts: I64,
    vector: bool,
    index: I32,
    weight_y: I32,
    weight_x: I32,
    patches: U32,
    warped: U8,
    row: int,
    pad: int,
) -> None:
    """Sample each colour on its own, from packed planes."""
    channels, _, padded = warped.shape
    flat = warped.reshape(-1)
    for c in range(channels):
        gather_row(packed, starts[c], index, patches)
        at = (c * warped.shape[1] + row) * padded + pad
        if vector:
            _blend_blocks(patches, weight_y, weight_x, flat, at)
        else:
            blend_row(patches, weight_x, weight_y, flat, at)


@kernel
def _blend_blocks(patches: U32, weight_y: I32, weight_x: I32, out: U8, out_at: int) -> None:
    """Do what `blend_row` does; the last block overlaps the one before it."""
    if HAS_VECTOR:  # a constant: without it the block is not compiled, which is impossible on other processors
        width = patches.shape[0]
        for i in range(0, width - PIXELS + 1, PIXELS):
            blend_grey_block(patches, weight_y, weight_x, _U(i), out, _U(out_at + i))
        last = width - PIXELS
        blend_grey_block(patches, weight_y, weight_x, _U(last), out, _U(out_at + last))


@kernel
def _sample_rgb(
    colors: U64, start: int, index: I32, weight_y: I32, weight_x: I32, warped: U8, row: int, pad: int
) -> None:
    """Sample three colours at once, from interleaved patches."""
    flat = warped.reshape(-1)
    step = _U(warped.shape[1] * warped.shape[2])
    out_at = row * warped.shape[2] + pad
    base = _U(start)
    width = index.shape[0]
    if HAS_VECTOR:
        for i in range(0, width - PIXELS + 1, PIXELS):
            sample_rgb_block(colors, base, index, weight_y, weight_x, _U(i), flat, _U(out_at + i), step)
        last = width - PIXELS
        sample_rgb_block(colors, base, index, weight_y, weight_x, _U(last), flat, _U(out_at + last), step)


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

    `colors`: (·,) uint64 `pack_colors`. `start`: where the source begins. `index`: (W,) int32, see `place_row`.
    `weight_y`: (W,) int32. `weight_x`: (W,) int32. `reference`: (rows, W) uint32 of `interleave_rows`. `row`: the row
    of the reference and of the costs. `pad`: width of the margin of the costs. `pixel_costs`: (rows, W + 2 pad) uint16,
    added to.
    """
    base, width = _U(start), reference.shape[1]
    ours, costs = row * width, row * pixel_costs.shape[1] + pad
    if HAS_VECTOR:  # a constant: without it the block is not compiled, which is impossible on other processors
        for i in range(0, width, PIXELS):
            difference_rgb_block(
                colors, base, index, weight_y, weight_x, _U(i), reference, _U(ours + i), pixel_costs, _U(costs + i)
            )


@kernel
def warp_band(
    first: int,
    height: int,
    sin_cos_azimuth: F32,
    sources: Sources,
    source: int,
    others: bool | None,
    virtual_range: float,
    pad: int,
    found: Lookup,
) -> None:
    """Look up the rows `first` … of the reference, at one depth hypothesis, in one source.

    Rows before the first or after the last one of the picture lie beyond a pole: elevations over 90° turn the ray
    around by themselves.

    `first`: the first row, may be negative. `height`: rows of the reference picture. `sin_cos_azimuth`: (2, W) float32.
    `sources`: all sources. `source`: the index of the one. `others`: see `Sweep`. `virtual_range`: in scene units.
    `pad`: width of the wrapped margin of the result. `found`: written.
    """
    pose, shape, starts = sources.poses[source], sources.shapes[source], sources.starts[source]
    packed, colors, vector = sources.packed, sources.colors, sources.vector
    valid, valid_start = sources.valid, sources.valid_starts[source]
    first_masked, after_masked = sources.masked[source]
    knots, warped, votes, against, pixel_costs = found
    width = sin_cos_azimuth.shape[1]
    x_px, y_px = np.empty(width, np.float32), np.empty(width, np.float32)
    index = np.empty(width, np.int32)
    weight_x, weight_y = np.empty(width, np.int32), np.empty(width, np.int32)
    patches = np.empty(width, np.uint32)
    matrix, offset = np.empty((3, 2), np.float32), np.empty(3, np.float32)
    exact = np.empty((2, width), np.float32)
    curve, rough = np.empty((2, 3, width), np.float32), np.empty(width, np.uint8)
    runs = np.empty((width // 16 + 1, 2), np.int64)
    count, exactly = 0, height < INTERPOLATED_FROM
    if not exactly:
        project_knots(first, height, sin_cos_azimuth, pose, virtual_range, shape, knots)
    for j in range(warped.shape[1]):
        if not exactly:
            base = min(max(j // EVERY - 1, 0), knots.shape[1] - 4)
            if j % EVERY == 0:
                fit_group(knots, base, _F(shape[1]), curve, rough)
                count = rough_runs(rough, runs)
            follow_curve(knots, base, curve, j / EVERY - base, x_px, y_px)
        if exactly or count:
            ray_row(first + j, height, pose, virtual_range, matrix, offset)
        if exactly:
            project_row(sin_cos_azimuth, matrix, offset, shape, 0, width, x_px, y_px)
        else:
            for k in range(count):
                project_row(sin_cos_azimuth, matrix, offset, shape, runs[k, 0], runs[k, 1], exact[0], exact[1])
                replace_rough(rough, exact, runs[k, 0], runs[k, 1], x_px, y_px)
        place_row(x_px, y_px, shape, index, weight_x, weight_y)
        if others is not None and len(against):
            add_sampled_differences(colors, starts[0], index, weight_y, weight_x, against, j, pad, pixel_costs)
        else:
            sample_row(packed, colors, others, starts, vector, index, weight_y, weight_x, patches, warped, j, pad)
        vote_row(valid, valid_start, first_masked, after_masked, index, votes, j)


@kernel
def sample_row(
    packed: U32,
    colors: U64,
    others: bool | None,
    starts: I64,
    vector: bool,
    index: I32,
    weight_y: I32,
    weight_x: I32,
    patches: U32,
    warped: U8,
    row: int,
    pad: int,
) -> None:
    """Sample one row of a source at places that are known. No records: at each row they would cost what they hold.

    `packed`: (·,) uint32 of `Sources`. `colors`: (·,) uint64 likewise. `others`: see `Sweep`. `starts`: (C or 1,) int64
    of this source. `vector`: whether to use vector instructions. `index`: (W,) int32 of the patches, see `place_row`.
    `weight_y`: (W,) int32. `weight_x`: (W,) int32. `patches`: (W,) uint32, scratch. `warped`: (C, rows, W + 2 pad)
    uint8, written. `row`: of `warped`. `pad`: width of the wrapped margin.
    """
    if others is not None and len(colors):
        _sample_rgb(colors, starts[0], index, weight_y, weight_x, warped, row, pad)
    else:
        _sample_planes(packed, starts, vector, index, weight_y, weight_x, patches, warped, row, pad)
    for c in range(warped.shape[0]):
        wrap_row(warped[c, row], index.shape[0], pad)


@kernel
def vote_row(valid: U8, start: int, first_masked: int, after_masked: int, index: I32, votes: U8, row: int) -> None:
    """Write whether the patches at `index`, (W,), are valid to a row of `votes`; nothing if all of the source's are.

    Masks often cover a few rows, such as those of a tripod, and most rows of a sweep are looked up in others.
    """
    if first_masked == after_masked:
        return
    lowest = highest = index[0]
    for i in range(_U(index.shape[0])):
        lowest = min(lowest, index[i])
        highest = max(highest, index[i])
    if highest < first_masked or lowest >= after_masked:
        votes[row] = 1
        return
    for i in range(_U(index.shape[0])):
        votes[_U(row), i] = valid[_U(start) + _U(index[i])]
