"""Compiled: semi-global matching among a few offsets from two guiding surfaces.

As in `kernels_sgm`, but a pixel has candidates (a, k), k offsets from its guide a, instead of all planes: a tube around
the guides (M. Rothermel et al., "SURE: photogrammetric surface reconstruction from imagery", LC3D workshop 2012). From
one pixel to the next, a path that keeps its offset from a guide pays nothing where the two guides are one surface, as
if the guide were flat (a prior on the slant: D. Scharstein et al., "Surface orientation priors for semi-global
matching", 3DV 2017), P1 for a step by one offset, and P2 for any other candidate.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I16, U8, U16
from pano_mvs.core.kernels import kernel

_F = np.float32
_U = np.uint64
_H = np.uint16
_OUTSIDE = np.uint16(60000)  # as in kernels_sgm
_BARRED, _OPEN = np.uint16(65535), np.uint16(0)

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

    Attributes:
        paths: (2, K + 2, lines) uint16 costs of the paths, with a plane beyond either end.
        least: (lines,) uint16 the least of each.
        guides: (2, lines) int16 positions of the guides.
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
                barred[a, b, k] = _BARRED if abs(gap) > _ONE_SURFACE else _OPEN


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

    Args:
        volume: (H, 2 K, W) uint8, K offsets of either guide.
        total: (H, 2 K, W) uint16, added to.
        guides: (H, 2, W) int16 positions among planes, in 1/PER_PLANE.
        penalties: (H, W) uint16 P2 of the step into each pixel.
        p1: uint16.
        first: column of the first line in row 0 (row H − 1 for upward paths).
        lines: number of lines.
        drift: columns by which a path moves in each step.
        upward: whether the paths run from the last row to the first.
        warm: steps before the first row, which only prepare the state.
        beyond_pole: whether rows −1, −2 … are 0, 1 … half a turn further on; else they are H − 1, H − 2 …
    """
    height, depth, width = volume.shape
    count = depth // 2
    costs = Costs(volume, total, guides, penalties, p1)
    buffers = np.zeros((2, 2, count + 2, lines), np.uint16)
    buffers[:, :, 0, :] = _OUTSIDE
    buffers[:, :, count + 1, :] = _OUTSIDE
    least = np.zeros((2, lines), np.uint16)
    passed = np.zeros((2, 2, lines), np.int16)
    nearby, barred = np.empty((2, count, lines), np.uint16), np.empty((2, 2, lines), np.uint16)
    for i in range(-warm, height):
        now, before = (i + warm) % 2, (i + warm + 1) % 2
        row = i if i >= 0 else (-1 - i if beyond_pole else i + height)
        row = height - 1 - row if upward else row
        column = first + drift * i + (width // 2 if beyond_pole and i < 0 else 0)
        column = (column % width + width) % width
        least[now, :] = _OUTSIDE
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

    Args:
        volume: (H, 2 K, W) uint8.
        total: (H, 2 K, W) uint16, added to.
        guides: (H, 2, W) int16, as of `follow_guided_strip`.
        penalties: (2, H, W) uint16 P2 of the step into each pixel from its left and from its right.
        p1: uint16.
        first: the first row.
        lines: number of rows.
        warm: steps before the seam, which only prepare the state.
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

    Args:
        total: (H, 2 K, W) costs of any type.
        guides: (2, H, W) float32 positions among planes.
        first: the first row.
        planes: number of planes; candidates beyond the first and the last one do not count.
        position: (rows, W) float32, written: of the cheapest one.
        costs: (4, rows, W) float32, written: its cost; that of the offset before and after it, its own where there is
            none; the least cost of all that are more than 1.5 planes from it.
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
