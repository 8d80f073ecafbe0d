"""Compiled: sample one source for a band of rows of the reference at one depth hypothesis."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_project import (
    EVERY,
    fit_group,
    follow_curve,
    project_knots,
    ray_row,
    replace_rough,
    rough_runs,
)
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I32, I64, U8, U32, U64, Lookup, Sources
from pano_mvs.algorithms.sweep.numba.kernels_sad import add_sampled_differences
from pano_mvs.algorithms.sweep.numba.kernels_warp import blend_row, gather_row, place_row, project_row, wrap_row
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR, PIXELS, blend_grey_block, sample_rgb_block
from pano_mvs.core.kernels import kernel

_F = np.float32
_U = np.uint64


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
def warp_band(
    first: int,
    height: int,
    sin_cos_azimuth: F32,
    sources: Sources,
    source: int,
    virtual_range: float,
    pad: int,
    found: Lookup,
) -> None:
    """Look up the rows `first` … of the reference, at one depth hypothesis, in one source.

    Rows before the first or after the last one of the picture lie beyond a pole: elevations over 90° turn the ray
    around by themselves.

    Args:
        first: the first row, may be negative.
        height: rows of the reference picture.
        sin_cos_azimuth: (2, W) float32.
        sources: all sources.
        source: the index of the one.
        virtual_range: in scene units.
        pad: width of the wrapped margin of the result.
        found: written.
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
    count = 0
    project_knots(first, height, sin_cos_azimuth, pose, virtual_range, shape, knots)
    for j in range(warped.shape[1]):
        base = min(max(j // EVERY - 1, 0), knots.shape[1] - 4)
        if j % EVERY == 0:
            fit_group(knots, base, height, _F(shape[1]), curve, rough)
            count = rough_runs(rough, runs)
        follow_curve(knots, base, curve, j / EVERY - base, x_px, y_px)
        if count:
            ray_row(first + j, height, pose, virtual_range, matrix, offset)
            for k in range(count):
                project_row(sin_cos_azimuth, matrix, offset, shape, runs[k, 0], runs[k, 1], exact[0], exact[1])
                replace_rough(rough, exact, runs[k, 0], runs[k, 1], x_px, y_px)
        place_row(x_px, y_px, shape, index, weight_x, weight_y)
        if len(against):
            add_sampled_differences(colors, starts[0], index, weight_y, weight_x, against, j, pad, pixel_costs)
        else:
            sample_row(packed, colors, starts, vector, index, weight_y, weight_x, patches, warped, j, pad)
        vote_row(valid, valid_start, first_masked, after_masked, index, votes, j)


@kernel
def sample_row(
    packed: U32,
    colors: U64,
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

    Args:
        packed: (·,) uint32 of `Sources`.
        colors: (·,) uint64 likewise.
        starts: (C or 1,) int64 of this source.
        vector: whether to use vector instructions.
        index: (W,) int32 of the patches, see `place_row`.
        weight_y: (W,) int32.
        weight_x: (W,) int32.
        patches: (W,) uint32, scratch.
        warped: (C, rows, W + 2 pad) uint8, written.
        row: of `warped`.
        pad: width of the wrapped margin.
    """
    if len(colors):
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
