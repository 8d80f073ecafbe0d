"""Compiled: the sweep near approximate surfaces, at offsets from each pixel's own depth hypothesis.

The rows are warped as a whole at once, as in the plain sweep, but by a surface instead of by a sphere. Windows then
lie on the surface, slanted as it is, and few offsets do.

Semi-global matching is as in `kernels_sgm`, but a pixel has candidates (a, k), k offsets from its guide a, instead of
all planes: a tube around the guides (M. Rothermel et al., "SURE: photogrammetric surface reconstruction from imagery",
LC3D workshop 2012). From one pixel to the next, a path that keeps its offset from a guide pays nothing where the two
guides are one surface, as if the guide were flat (a prior on the slant: D. Scharstein et al., "Surface orientation
priors for semi-global matching", 3DV 2017), P1 for a step by one offset, and P2 for any other candidate.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.kernels_band import combine_row
from pano_mvs.algorithms.sweep.numba.kernels_cost import silence, source_cost, store_row
from pano_mvs.algorithms.sweep.numba.kernels_lookup import place_row, sample_row, vote_row
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I16, I64, U8, U16, Guide, Lookup, Sweep
from pano_mvs.algorithms.sweep.numba.kernels_sgm import OUTSIDE
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import fast_azimuth, fast_dip

_F = np.float32
_U = np.uint64


@kernel
def inverse_row(guide: F32, shift: int, table: F32, per_plane: int, inverse: F32) -> None:
    """Look up the inverse ranges at `guide + shift`.

    `guide`: (W,) float32 positions among planes. `shift`: planes. `table`: (N,) float32 inverse ranges at positions 0,
    1/per_plane, 2/per_plane …; linear in between, and as at its ends beyond them. `per_plane`: entries for each plane.
    `inverse`: (W,) float32, written.
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

    `sin_cos_azimuth`: (2, W) float32 sin θ and cos θ. `matrix`: (3, 2) float32. `offset`: (3,) float32. `translation`:
    (3,) float32: x_in_source / range = matrix @ (sin θ, cos θ) + offset + translation · inverse. `inverse`: (W,)
    float32 inverse ranges. `shape`: (2,) int64 rows and columns of the source picture. `x_px`: (W,) float32, written,
    as by `project_row`. `y_px`: (W,) float32, written.
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
def warp_guided_band(
    first: int, sweep: Sweep, others: bool | None, source: int, guide: Guide, shift: int, found: Lookup
) -> None:
    """Look up the rows `first` …, `shift` planes beyond the guide, in one source.

    `first`: the first row, may be negative. `sweep`: the sources and the directions of the columns. `others`: its
    field. `source`: the index of the source. `guide`: the surface, in these rows. `shift`: planes. `found`: written;
    `knots`, `against` and `pixel_costs` are not used.
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
        sample_row(packed, colors, others, starts, vector, index, weight_y, weight_x, patches, warped, j, pad)
        vote_row(valid, valid_start, first_masked, after_masked, index, votes, j)


@kernel
def sweep_guided_band(first: int, sweep: Sweep, others: bool | None, guide: Guide, costs: NDArray[Any]) -> None:
    """Compute the costs of one band at some planes on either side of the guide.

    `first`: the first row of the band. `sweep`: what all bands share. `others`: its field. `guide`: the surface, in the
    rows of the band and compare_radius + box_radius rows on either side. `costs`: (rows, 2 steps + 1, W), written:
    uint8 on the scale of the volume; float32 means if `sweep.scale` is 0.
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
            warp_guided_band(first - halo, sweep, others, s, guide, k - count // 2, found)
            source_cost(first, sweep, others, warped, pixel_costs, scratch, means[s])
            if sweep.sources.masked[s, 0] < sweep.sources.masked[s, 1]:
                silence(votes, halo, means[s])
        for j in range(rows):
            combine_row(means, j, sweep.combination, first + j, all_vote, combined)
            if sweep.scale > _F(0):
                store_row(combined, sweep.scale, costs[j, k])
            else:
                for i in range(_U(width)):
                    costs[j, k, i] = combined[i]


@kernel
def lower_at_candidates(costs: U8, guide: F32, volume: U8) -> None:
    """Lower the costs of the planes among the candidates to what lies between the two candidates around each.

    They rise by 10 for each plane from the guide, which decides where there is no texture.

    `costs`: (rows, 2 steps + 1, W) at offsets from the guide. `guide`: (rows, W) positions among planes; −∞ where it
    is not seen. `volume`: (rows, D, W) costs, lowered.
    """
    count, last = costs.shape[1], volume.shape[1] - 1
    for j in range(guide.shape[0]):
        for i in range(guide.shape[1]):
            if guide[j, i] >= _F(0):
                first = guide[j, i] - _F(count // 2)
                start = int(np.ceil(first))
                share = _F(start) - first
                for k in range(count - 1):
                    plane = start + k
                    if 0 <= plane <= last:
                        between = (_F(1) - share) * costs[j, k, i] + share * costs[j, k + 1, i]
                        between += _F(10) * abs(_F(plane) - guide[j, i])
                        volume[j, plane, i] = min(volume[j, plane, i], int(between + _F(0.5)))


@kernel
def raise_beyond(farthest: F32, half_width: I64, volume: U8, row: int) -> None:
    """Raise the costs of a row of a volume, (rows, D, W), beyond the farthest position among planes, (rows, W).

    A ray is left as it is if most rays up to `half_width`, (rows,) columns, on either side of it match better beyond:
    there is a hole in the floor.
    """
    count, width = volume.shape[1:]
    better = np.zeros(width, np.int32)
    for i in range(width):
        if farthest[row, i] < _F(count):
            least = volume[row, :, i].argmin()
            better[i] = _F(least) > farthest[row, i]
    half = half_width[row]
    around = better[-half:].sum() + better[: half + 1].sum()
    for i in range(width):
        if 2 * around <= 2 * half + 1:
            for d in range(count):
                if _F(d) > farthest[row, i]:
                    # A chance match costs 127, a right one on texture a third of it. 20 and 80 did much the same.
                    volume[row, d, i] = min(volume[row, d, i] + 40, 255)
        around += better[(i + half + 1) % width] - better[(i - half) % width]


_H = np.uint16

PER_PLANE = 4
"""Units of integer guides for each plane."""

_ONE_SURFACE = np.int16(4 * PER_PLANE)


class Costs(NamedTuple):
    """What the paths of one direction read and write, as of `follow_guided_strip`."""

    volume: U8
    total: U16
    guides: I16
    penalties: U16
    p1: np.uint16


class Front(NamedTuple):
    """Where the paths have come to, in one row.

    `paths`: (2, K + 2, lines) uint16 costs of the paths, with a plane beyond either end. `least`: (lines,) uint16 the
    least of each. `guides`: (2, lines) int16 positions of the guides.
    """

    paths: U16
    least: U16
    guides: I16


@kernel
def _link(guides: I16, row: int, column: int, first: int, lines: int, before: I16, now: I16, barred: U16) -> None:
    """Find which guides of the pixels before are one surface with which of these; see `_step`."""
    layers = guides.shape[1]
    for a in range(_U(layers)):
        for k in range(lines):
            now[a, first + k] = guides[row, a, column + k]
        for b in range(_U(layers)):
            for k in range(lines):
                gap = np.int16(now[a, first + k] - before[b, first + k])
                barred[a, b, k] = _H(65535) if abs(gap) > _ONE_SURFACE else _H(0)


@kernel
def _near_steps(before: U16, p1: np.uint16, first: int, lines: int, nearby: U16) -> None:
    """Compute what each candidate would inherit along its own guide: from the same offset or, for P1, from the next."""
    layers, padded = before.shape[:2]
    for b in range(_U(layers)):
        for d in range(_U(padded - 2)):
            for k in range(lines):
                line = first + k
                stay = before[b, d + _U(1), line]
                down, up = _H(before[b, d, line] + p1), _H(before[b, d + _U(2), line] + p1)
                near = down if down < up else up
                nearby[b, d, k] = stay if stay < near else near


@kernel
def _step(
    costs: Costs,
    place: tuple[int, int],
    segment: tuple[int, int],
    before: Front,
    after: Front,
    nearby: U16,
    barred: U16,
    keep: bool,
) -> None:
    """Advance the lines of one segment by one row: `place` (row, column), `segment` (first line, lines)."""
    volume, total, penalties = costs.volume, costs.total, costs.penalties
    paths, least, least_before = after.paths, after.least, before.least
    row, column = _U(place[0]), _U(place[1])
    first, lines = _U(segment[0]), _U(segment[1])
    _link(costs.guides, row, column, first, lines, before.guides, after.guides, barred)
    _near_steps(before.paths, costs.p1, first, lines, nearby)
    count = _U(nearby.shape[1])
    for a in range(_U(2)):
        for d in range(count):
            voxel = a * count + d
            for k in range(lines):
                line = first + k
                floor = least_before[line]
                best = _H(floor + penalties[row, column + k])
                near, other = _H(nearby[0, d, k] | barred[a, 0, k]), _H(nearby[1, d, k] | barred[a, 1, k])
                near = near if near < other else other
                best = near if near < best else best
                value = _H(_H(best - floor) + _H(volume[row, voxel, column + k]))
                paths[a, d + _U(1), line] = value
                least[line] = value if value < least[line] else least[line]
            if keep:
                for k in range(lines):
                    total[row, voxel, column + k] = _H(total[row, voxel, column + k] + paths[a, d + _U(1), first + k])


@kernel
def follow_guided_strip(
    volume: U8,
    total: U16,
    guides: I16,
    penalties: U16,
    p1: np.uint16,
    first: int,
    lines: int,
    drift: int,
    upward: bool,
    warm: int,
    beyond_pole: bool,
) -> None:
    """Follow one strip of parallel paths from pole to pole and add their costs to the total; see `sweep_strip`.

    `volume`: (H, 2 K, W) uint8, K offsets of either guide. `total`: (H, 2 K, W) uint16, added to. `guides`: (H, 2, W)
    int16 positions among planes, in 1/PER_PLANE. `penalties`: (H, W) uint16 P2 of the step into each pixel. `p1`:
    uint16. `first`: column of the first line in row 0 (row H − 1 for upward paths). `lines`: number of lines. `drift`:
    columns by which a path moves in each step. `upward`: whether the paths run from the last row to the first. `warm`:
    steps before the first row, which only prepare the state. `beyond_pole`: whether rows −1, −2 … are 0, 1 … half a
    turn further on; else they are H − 1, H − 2 …
    """
    height, depth, width = volume.shape
    count = depth // 2
    costs = Costs(volume, total, guides, penalties, p1)
    buffers = np.zeros((2, 2, count + 2, lines), np.uint16)
    buffers[:, :, 0, :] = OUTSIDE
    buffers[:, :, count + 1, :] = OUTSIDE
    least = np.zeros((2, lines), np.uint16)
    passed = np.zeros((2, 2, lines), np.int16)
    nearby, barred = np.empty((2, count, lines), np.uint16), np.empty((2, 2, lines), np.uint16)
    for i in range(-warm, height):
        now, before = (i + warm) % 2, (i + warm + 1) % 2
        row = i if i >= 0 else (-1 - i if beyond_pole else i + height)
        row = height - 1 - row if upward else row
        column = first + drift * i + (width // 2 if beyond_pole and i < 0 else 0)
        column = (column % width + width) % width
        least[now, :] = OUTSIDE
        direct = min(lines, width - column)
        fronts = Front(buffers[before], least[before], passed[before]), Front(buffers[now], least[now], passed[now])
        _step(costs, (row, column), (0, direct), fronts[0], fronts[1], nearby, barred, i >= 0)
        if direct < lines:
            _step(costs, (row, 0), (direct, lines - direct), fronts[0], fronts[1], nearby, barred, i >= 0)


@kernel
def follow_guided_rows(
    volume: U8, total: U16, guides: I16, penalties: U16, p1: np.uint16, first: int, lines: int, warm: int
) -> None:
    """Follow both horizontal paths of some rows around the sphere: turned by 90°, they are a strip.

    `volume`: (H, 2 K, W) uint8. `total`: (H, 2 K, W) uint16, added to. `guides`: (H, 2, W) int16, as of
    `follow_guided_strip`. `penalties`: (2, H, W) uint16 P2 of the step into each pixel from its left and from its
    right. `p1`: uint16. `first`: the first row. `lines`: number of rows. `warm`: steps before the seam, which only
    prepare the state.
    """
    depth, width = volume.shape[1:]
    costs, sums = np.empty((width, depth, lines), np.uint8), np.zeros((width, depth, lines), np.uint16)
    turned = np.empty((width, 2, lines), np.int16)
    paid = np.empty((2, width, lines), np.uint16)
    for j in range(lines):
        for d in range(depth):
            for x in range(width):
                costs[x, d, j] = volume[first + j, d, x]
        for a in range(2):
            for x in range(width):
                turned[x, a, j] = guides[first + j, a, x]
                paid[a, x, j] = penalties[a, first + j, x]
    follow_guided_strip(costs, sums, turned, paid[0], p1, 0, lines, 0, False, warm, False)
    follow_guided_strip(costs, sums, turned, paid[1], p1, 0, lines, 0, True, warm, False)
    for j in range(lines):
        for d in range(depth):
            for x in range(width):
                total[first + j, d, x] = _H(total[first + j, d, x] + sums[x, d, j])


@kernel
def cheapest_candidates(total: NDArray[Any], guides: F32, first: int, planes: int, position: F32, costs: F32) -> None:
    """Find the cheapest candidate of each pixel of some rows, and what is around it.

    `total`: (H, 2 K, W) costs of any type. `guides`: (2, H, W) float32 positions among planes. `first`: the first row.
    `planes`: number of planes; candidates beyond the first and the last one do not count. `position`: (rows, W)
    float32, written: of the cheapest one. `costs`: (4, rows, W) float32, written: its cost; that of the offset before
    and after it, its own where there is none; the least cost of all that are more than 1.5 planes from it.
    """
    depth, width = total.shape[1:]
    count = depth // 2
    places = np.empty(depth, np.float32)
    for y in range(position.shape[0]):
        for x in range(width):
            least, best, rival = _F(np.inf), 0, _F(np.inf)
            for c in range(depth):
                place = guides[c // count, first + y, x] + _F(c % count - count // 2)
                places[c] = place
                inside = _F(-0.5) <= place <= _F(planes - 0.5)
                if inside and total[first + y, c, x] < least:
                    least, best = _F(total[first + y, c, x]), c
            for c in range(depth):
                if abs(places[c] - places[best]) > _F(1.5) and total[first + y, c, x] < rival:
                    rival = _F(total[first + y, c, x])
            inner = 0 < best % count < count - 1
            position[y, x] = min(max(places[best], _F(0)), _F(planes - 1))
            costs[0, y, x] = least
            costs[1, y, x] = _F(total[first + y, best - 1, x]) if inner else least
            costs[2, y, x] = _F(total[first + y, best + 1, x]) if inner else least
            costs[3, y, x] = rival


_INFINITE = np.float32(np.inf)


@kernel
def _means(positions: F32, y: int, x: int, side: int, middle: float, layers: F32) -> None:
    """Write the means of what is nearer than `middle` around a pixel and of the rest; the same if nothing is nearer."""
    below = above = _F(0)
    count = 0
    for j in range(side):
        for i in range(side):
            value = positions[y + j, x + i]
            if value < middle:
                below += value
                count += 1
            else:
                above += value
    layers[1, y, x] = above / _F(side * side - count)
    layers[0, y, x] = below / _F(count) if count else layers[1, y, x]


@kernel
def split_layers(positions: F32, radius: int, least_gap: float, layers: F32) -> None:
    """Separate the two surfaces around each pixel where they meet.

    `positions`: (H + 2 radius, W + 2 radius) float32 positions among planes, padded over the seam and the poles.
    `radius`: pixels on either side that are looked at. `least_gap`: planes between the nearest and the farthest of them
    from which on there are two surfaces. `layers`: (2, H, W) float32, written: the mean of those around that are nearer
    than the middle between nearest and farthest, and that of the others; twice the mean of all where there is one
    surface.
    """
    side = 2 * radius + 1
    for y in range(layers.shape[1]):
        for x in range(layers.shape[2]):
            low = high = positions[y, x]
            for j in range(side):
                for i in range(side):
                    low = min(low, positions[y + j, x + i])
                    high = max(high, positions[y + j, x + i])
            middle = _F(0.5) * (low + high) if high - low >= least_gap else -_INFINITE
            _means(positions, y, x, side, middle, layers)


@kernel
def adopt_candidates(found: F32, costs: F32, radius: int, least_gap: float, layer: F32) -> None:
    """Replace a guide around candidates that are cheaper, by the mean of those around that agree with the cheapest.

    `found`: (H + 2 radius, W + 2 radius) float32 positions of the candidates, padded over the seam and the poles.
    `costs`: likewise their costs; infinite where there is none. `radius`: pixels on either side that are looked at.
    `least_gap`: planes from which on candidates are of different surfaces. `layer`: (H, W) float32, written where there
    is a candidate around.
    """
    side = 2 * radius + 1
    for y in range(layer.shape[0]):
        for x in range(layer.shape[1]):
            least, place = _INFINITE, _F(0)
            for j in range(side):
                for i in range(side):
                    if costs[y + j, x + i] < least:
                        least, place = costs[y + j, x + i], found[y + j, x + i]
            if least == _INFINITE:
                continue
            total, count = _F(0), 0
            for j in range(side):
                for i in range(side):
                    if costs[y + j, x + i] < _INFINITE and abs(found[y + j, x + i] - place) < least_gap:
                        total += found[y + j, x + i]
                        count += 1
            layer[y, x] = total / _F(count)
