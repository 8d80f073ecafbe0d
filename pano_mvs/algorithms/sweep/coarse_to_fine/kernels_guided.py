"""Compiled: the sweep near approximate surfaces, at offsets from each pixel's own depth hypothesis.

The rows are warped as a whole at once, as in the plain sweep, but by a surface instead of by a sphere. Windows then
lie on the surface, slanted as it is, and few offsets do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.kernels_combine import combine_row
from pano_mvs.algorithms.sweep.numba.kernels_lookup import sample_row, vote_row
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I64, Guide, Lookup, Sweep
from pano_mvs.algorithms.sweep.numba.kernels_source_cost import silence, source_cost, store_row
from pano_mvs.algorithms.sweep.numba.kernels_warp import place_row
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import fast_azimuth, fast_dip

_F = np.float32
_U = np.uint64


@kernel
def inverse_row(guide: F32, shift: int, table: F32, per_plane: int, inverse: F32) -> None:
    """Look up the inverse ranges at `guide + shift`.

    Args:
        guide: (W,) float32 positions among planes.
        shift: planes.
        table: (N,) float32 inverse ranges at positions 0, 1/per_plane, 2/per_plane …; linear in between, and as at its
            ends beyond them.
        per_plane: entries for each plane.
        inverse: (W,) float32, written.
    """
    last = np.int32(len(table) - 1)
    for i in range(_U(guide.shape[0])):
        place = (guide[i] + _F(shift)) * _F(per_plane)
        place = place if place > _F(0) else _F(0)
        place = place if place < _F(last) else _F(last)
        entry = np.int32(place)
        entry = entry if entry < last else np.int32(last - np.int32(1))
        before, after = table[_U(entry)], table[_U(entry) + _U(1)]
        inverse[i] = before + (place - _F(entry)) * (after - before)


@kernel
def project_guided_row(
    sin_cos_azimuth: F32, matrix: F32, offset: F32, translation: F32, inverse: F32, shape: I64, x_px: F32, y_px: F32
) -> None:
    """Find where a row of rays, each with its own range, arrives in a packed source.

    Args:
        sin_cos_azimuth: (2, W) float32 sin θ and cos θ.
        matrix: (3, 2) float32.
        offset: (3,) float32.
        translation: (3,) float32: x_in_source / range = matrix @ (sin θ, cos θ) + offset + translation · inverse.
        inverse: (W,) float32 inverse ranges.
        shape: (2,) int64 rows and columns of the source picture.
        x_px: (W,) float32, written, as by `project_row`.
        y_px: (W,) float32, written.
    """
    m00, m01, o0, t0 = matrix[0, 0], matrix[0, 1], offset[0], translation[0]
    m10, m11, o1, t1 = matrix[1, 0], matrix[1, 1], offset[1], translation[1]
    m20, m21, o2, t2 = matrix[2, 0], matrix[2, 1], offset[2], translation[2]
    x_scale, y_scale = _F(shape[1] / (2 * np.pi)), _F(shape[0] / np.pi)
    x_middle, y_middle = _F(shape[1] / 2 + 0.5), _F(shape[0] / 2 + 0.5)
    for i in range(_U(x_px.shape[0])):
        s, c, nearness = sin_cos_azimuth[0, i], sin_cos_azimuth[1, i], inverse[i]
        x = m00 * s + m01 * c + o0 + t0 * nearness
        y = m10 * s + m11 * c + o1 + t1 * nearness
        z = m20 * s + m21 * c + o2 + t2 * nearness
        x_px[i] = fast_azimuth(x, z) * x_scale + x_middle
        y_px[i] = fast_dip(y, np.sqrt(x * x + z * z)) * y_scale + y_middle


@kernel
def warp_guided_band(first: int, sweep: Sweep, source: int, guide: Guide, shift: int, found: Lookup) -> None:
    """Look up the rows `first` …, `shift` planes beyond the guide, in one source.

    Args:
        first: the first row, may be negative.
        sweep: the sources and the directions of the columns.
        source: the index of the source.
        guide: the surface, in these rows.
        shift: planes.
        found: written; `knots`, `against` and `pixel_costs` are not used.
    """
    sources, height = sweep.sources, sweep.windows.offsets.shape[0]
    pose, shape, starts = sources.poses[source], sources.shapes[source], sources.starts[source]
    packed, colors, vector = sources.packed, sources.colors, sources.vector
    valid, valid_start = sources.valid, sources.valid_starts[source]
    first_masked, after_masked = sources.masked[source]
    warped, votes, pad = found.warped, found.votes, sweep.windows.pad
    positions, table, per_plane = guide
    sin_cos_azimuth = sweep.sin_cos_azimuth
    width = sin_cos_azimuth.shape[1]
    x_px, y_px = np.empty(width, np.float32), np.empty(width, np.float32)
    index, inverse = np.empty(width, np.int32), np.empty(width, np.float32)
    weight_x, weight_y = np.empty(width, np.int32), np.empty(width, np.int32)
    patches = np.empty(width, np.uint32)
    matrix, offset, translation = np.empty((3, 2), np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    for j in range(warped.shape[1]):
        elevation = np.pi * (0.5 - (first + j + 0.5) / height)
        for a in range(3):
            matrix[a, 0] = _F(np.cos(elevation) * pose[a, 0])
            matrix[a, 1] = _F(np.cos(elevation) * pose[a, 2])
            offset[a] = _F(-np.sin(elevation) * pose[a, 1])
            translation[a] = _F(pose[a, 3])
        inverse_row(positions[j], shift, table, per_plane, inverse)
        project_guided_row(sin_cos_azimuth, matrix, offset, translation, inverse, shape, x_px, y_px)
        place_row(x_px, y_px, shape, index, weight_x, weight_y)
        sample_row(packed, colors, starts, vector, index, weight_y, weight_x, patches, warped, j, pad)
        vote_row(valid, valid_start, first_masked, after_masked, index, votes, j)


@kernel
def sweep_guided_band(first: int, sweep: Sweep, guide: Guide, costs: NDArray[Any]) -> None:
    """Compute the costs of one band at some planes on either side of the guide.

    Args:
        first: the first row of the band.
        sweep: what all bands share.
        guide: the surface, in the rows of the band and compare_radius + box_radius rows on either side.
        costs: (rows, 2 steps + 1, W), written: uint8 on the scale of the volume; float32 means if `sweep.scale` is 0.
    """
    rows, count, width = costs.shape
    windows = sweep.windows
    sources, halo, pad = sweep.sources.starts.shape[0], windows.compare_radius + windows.box_radius, windows.pad
    all_vote = len(sweep.sources.valid) == 0
    warped = np.empty((sweep.reference.shape[0], rows + 2 * halo, width + 2 * pad), np.uint8)
    votes = np.empty((rows + 2 * halo, width), np.uint8)
    pixel_costs = np.empty((rows + 2 * windows.box_radius, width + 2 * pad), np.uint16)
    scratch = np.empty((2, width + 2 * pad), np.int32)
    means = np.empty((sources, rows, width), np.float32)
    combined = np.empty(width, np.float32)
    found = Lookup(np.empty((0, 0, 0), np.float32), warped, votes, np.empty((0, 0), np.uint32), pixel_costs)
    for k in range(count):
        for s in range(sources):
            warp_guided_band(first - halo, sweep, s, guide, k - count // 2, found)
            source_cost(first, sweep, warped, pixel_costs, scratch, means[s])
            if sweep.sources.masked[s, 0] < sweep.sources.masked[s, 1]:
                silence(votes, halo, means[s])
        for j in range(rows):
            combine_row(means, j, sweep.combination, first + j, all_vote, combined)
            if sweep.scale > _F(0):
                store_row(combined, sweep.scale, costs[j, k])
            else:
                costs[j, k] = combined
