"""Compiled: the sweep near surfaces that are known roughly, each pixel at offsets from its own virtual range.

The rows are warped as a whole at once, as in the plain sweep, but by a surface instead of by a sphere. Windows then
lie on the surface, slanted as it is, and few offsets do.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pano_mvs.algorithms.sweep.numba.kernels_band import source_cost, store_row
from pano_mvs.algorithms.sweep.numba.kernels_combine import combine_row
from pano_mvs.algorithms.sweep.numba.kernels_lookup import _sample_planes, _sample_rgb
from pano_mvs.algorithms.sweep.numba.kernels_warp import _atan_unit, place_row, wrap_row

_F = np.float32
_U = np.uint64
_HALF_PI, _PI, _TINY = _F(np.pi / 2), _F(np.pi), _F(1e-30)


@njit(cache=True, error_model="numpy", nogil=True)
def inverse_row(guide, shift, table, per_plane, inverse):  # type: ignore[no-untyped-def]
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


@njit(cache=True, error_model="numpy", nogil=True)
def project_guided_row(sin_cos_azimuth, matrix, offset, translation, inverse, shape, x_px, y_px):  # type: ignore[no-untyped-def]
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
        ax, ay, az = abs(x), abs(y), abs(z)
        small = ax if ax < az else az
        large = az if ax < az else ax
        turn = _atan_unit(small / (large + _TINY))
        turn = _HALF_PI - turn if ax > az else turn
        turn = _PI - turn if z < _F(0) else turn
        turn = -turn if x < _F(0) else turn
        level = np.sqrt(x * x + z * z)
        small = ay if ay < level else level
        large = level if ay < level else ay
        dip = _atan_unit(small / (large + _TINY))
        dip = _HALF_PI - dip if ay > level else dip
        dip = -dip if y < _F(0) else dip
        x_px[i] = turn * x_scale + x_middle
        y_px[i] = dip * y_scale + y_middle


@njit(cache=True, error_model="numpy", nogil=True)
def warp_guided_band(  # type: ignore[no-untyped-def]
    first, height, sin_cos_azimuth, pose, guide, shift, table, per_plane, packed, colors, starts, shape, valid,
    valid_start, vector, pad, warped, votes,
):  # fmt: skip
    """Look up the rows `first` …, `shift` planes beyond the guide, in one source.

    `guide` is (rows, W) float32 positions among planes, `shift` in planes, `table` and `per_plane` as of `inverse_row`,
    all others as of `warp_band`.
    """
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
        inverse_row(guide[j], shift, table, per_plane, inverse)
        project_guided_row(sin_cos_azimuth, matrix, offset, translation, inverse, shape, x_px, y_px)
        place_row(x_px, y_px, shape, index, weight_x, weight_y)
        if len(colors):
            _sample_rgb(colors, starts[0], index, weight_y, weight_x, warped, j, pad)
        else:
            _sample_planes(packed, starts, vector, index, weight_y, weight_x, patches, warped, j, pad)
        for c in range(warped.shape[0]):
            wrap_row(warped[c, j], width, pad)
        if len(valid):
            for i in range(_U(width)):
                votes[_U(j), i] = valid[_U(valid_start) + _U(index[i])]


@njit(cache=True, error_model="numpy", nogil=True)
def sweep_guided_band(  # type: ignore[no-untyped-def]
    first, guide, steps, table, per_plane, reference, sin_cos_azimuth, poses, packed, colors, starts, shapes, valid,
    valid_starts, vector, offsets, reach, cost, census_weight, compare_radius, box_radius, pad, weights, share, most,
    scale, neutral, costs,
):  # fmt: skip
    """Compute the costs of one band at −steps … steps planes from the guide.

    `guide` is (rows + 2 (compare_radius + box_radius), W) float32 positions among planes, with the rows around; `table`
    and `per_plane` as of `inverse_row`; `costs` (rows, 2 steps + 1, W), written: uint8 on the scale of the volume, or
    float32 means if `scale` is 0; all others as of `sweep_band`.
    """
    rows, count, width = costs.shape
    sources, halo = starts.shape[0], compare_radius + box_radius
    warped = np.empty((reference.shape[0], rows + 2 * halo, width + 2 * pad), np.uint8)
    votes = np.empty((rows + 2 * halo, width), np.uint8)
    pixel_costs = np.empty((rows + 2 * box_radius, width + 2 * pad), np.uint16)
    scratch = np.empty((2, width + 2 * pad), np.int32)
    means = np.empty((sources, rows, width), np.float32)
    combined = np.empty(width, np.float32)
    for k in range(count):
        for s in range(sources):
            warp_guided_band(
                first - halo, offsets.shape[0], sin_cos_azimuth, poses[s], guide, k - steps, table, per_plane, packed,
                colors, starts[s], shapes[s], valid, valid_starts[s], vector, pad, warped, votes,
            )  # fmt: skip
            source_cost(
                first, reference, warped, offsets, reach, cost, census_weight, compare_radius, box_radius, pad,
                pixel_costs, scratch, means[s],
            )  # fmt: skip
            if len(valid):
                for j in range(rows):
                    for i in range(width):
                        if votes[j + halo, i] == 0:
                            means[s, j, i] = np.inf
        for j in range(rows):
            combine_row(means, j, weights, first + j, share, most, len(valid) == 0, neutral, combined)
            if scale > _F(0):
                store_row(combined, scale, costs[j, k])
            else:
                costs[j, k] = combined
