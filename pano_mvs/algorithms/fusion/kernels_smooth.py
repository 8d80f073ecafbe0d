"""Compiled: the height of the surface of a point's neighbours above the point."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.fusion.kernels_fuse import solve_symmetric
from pano_mvs.core.kernels import inlined, kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Cloud = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
Cells = tuple[IntArray, IntArray, IntArray, IntArray, IntArray]

BLOCK = 128
"""Number of neighbours that are weighed together."""

_U = np.uint64
_RADIX_BITS = 11
_RADIX = 1 << _RADIX_BITS

_MAX_DEVIATIONS = 2.5
_MAX_OFF_CENTER = 0.3


@inlined
def column_range(keys: IntArray, starts: IntArray, key: int) -> tuple[int, int]:
    """Return where the points of a cell and of those before and behind it begin and end; their keys are successive."""
    first = int(np.searchsorted(keys, key - 1))
    end = first
    while end < len(keys) and keys[end] <= key + 1:
        end += 1
    return starts[first], starts[end]


@inlined
def tangents(normal: NDArray[np.float32]) -> tuple[float, float, float, float, float, float]:
    """Return two unit vectors perpendicular to a normal and to each other."""
    x, y, z = float(normal[0]), float(normal[1]), float(normal[2])
    # Across the axis that is least aligned with the normal.
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        a, b, c = 0.0, z, -y
    elif abs(y) <= abs(z):
        a, b, c = -z, 0.0, x
    else:
        a, b, c = y, -x, 0.0
    length = math.sqrt(a * a + b * b + c * c)
    a, b, c = a / length, b / length, c / length
    return a, b, c, y * c - z * b, z * a - x * c, x * b - y * a


@kernel
def find_cells(points: NDArray[np.float32], least: NDArray[np.float32], edge: float, shape: IntArray) -> IntArray:
    """Return the key of the cell, (N,), of each point: cells have this edge, from 1 in each axis, and rows of cells.

    `points`: (N, 3). `least`: (3,) the least coordinates. `edge`: of a cell. `shape`: (3,) number of cells in each
    axis, with one more on either side.
    """
    keys = np.empty(len(points), np.int64)
    for i in range(len(points)):
        x = np.int64(np.floor((points[i, 0] - least[0]) / edge)) + 1
        y = np.int64(np.floor((points[i, 1] - least[1]) / edge)) + 1
        z = np.int64(np.floor((points[i, 2] - least[2]) / edge)) + 1
        keys[i] = (x * shape[1] + y) * shape[2] + z
    return keys


@kernel
def sort_keys(keys: IntArray, most: int) -> tuple[IntArray, IntArray]:
    """Return keys (N,) from 0 to `most` in order, and their positions; the first of equals first (a radix sort)."""
    order, other_order = np.arange(len(keys)), np.empty(len(keys), np.int64)
    keys, other_keys = keys.copy(), np.empty(len(keys), np.int64)
    places = np.empty(_RADIX, np.int64)
    shift = 0
    while most >> shift > 0:
        places[:] = 0
        for i in range(len(keys)):
            places[(keys[i] >> shift) & (_RADIX - 1)] += 1
        place = 0
        for digit in range(_RADIX):
            place, places[digit] = place + places[digit], place
        for i in range(len(keys)):
            digit = (keys[i] >> shift) & (_RADIX - 1)
            other_keys[places[digit]], other_order[places[digit]] = keys[i], order[i]
            places[digit] += 1
        keys, other_keys, order, other_order = other_keys, keys, other_order, order
        shift += _RADIX_BITS
    return keys, order


@kernel
def find_starts(own: IntArray) -> tuple[IntArray, IntArray]:
    """Return the different keys (K,) of sorted keys (N,), and where each begins, (K + 1,), the last one ends."""
    count = 0
    for i in range(len(own)):
        count += i == 0 or own[i] != own[i - 1]
    keys, starts = np.empty(count, np.int64), np.empty(count + 1, np.int64)
    count = 0
    for i in range(len(own)):
        if i == 0 or own[i] != own[i - 1]:
            keys[count], starts[count] = own[i], i
            count += 1
    starts[count] = len(own)
    return keys, starts


@kernel
def gather_neighbours(cloud: Cloud, cells: Cells, cell: int, most: int, near: NDArray[np.float32]) -> int:
    """Write the points around a cell, in blocks of `BLOCK`, and return how many there are.

    `cloud`: see `find_heights`. `cells`: see `find_heights`. `cell`: key of the cell. `most`: number of points of a
    column that count, evenly among them. `near`: (blocks · 7 · BLOCK,) written: in each block positions, normals and
    standard deviations, one after the other.
    """
    points, normals, sigmas = cloud
    keys, starts, _, steps, order = cells
    count = 0
    for c in range(len(steps)):
        begin, end = column_range(keys, starts, cell + steps[c])
        inside = min(end - begin, most)
        for k in range(inside):
            j = order[begin + k * (end - begin) // inside]
            place = count // BLOCK * (7 * BLOCK) + count % BLOCK
            for axis in range(3):
                near[place + axis * BLOCK] = points[j, axis]
                near[place + (3 + axis) * BLOCK] = normals[j, axis]
            near[place + 6 * BLOCK] = sigmas[j]
            count += 1
    return count


@kernel
def weigh_block(
    near: NDArray[np.float32],
    first: int,
    count: int,
    own: tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32, np.float32],
    axes: tuple[float, float, float, float, float, float],
    radius: float,
    weighed: FloatArray,
) -> None:
    """Weigh a block of neighbours of a point, in a loop that can be vectorised.

    `near`: see `gather_neighbours`. `first`: where the block begins. `count`: number of points in it. `own`: the point,
    its normal, and its standard deviation. `axes`: two unit vectors perpendicular to the normal. `radius`: within which
    neighbours count. `weighed`: (4 · BLOCK,) written: weights, 0 if unused; heights along the normal; and positions
    along the axes, in radii.
    """
    px, py, pz, nx, ny, nz, sigma = own
    ux, uy, uz, vx, vy, vz = axes
    base, block = _U(first), _U(BLOCK)
    for i in range(_U(count)):
        k = base + i
        x, y, z = near[k] - px, near[k + block] - py, near[k + _U(2) * block] - pz
        height = x * nx + y * ny + z * nz
        share = (x * x + y * y + z * z - height * height) / (radius * radius)
        other = near[k + _U(6) * block]
        variance = sigma * sigma + other * other
        deviation = height * height / (_MAX_DEVIATIONS * _MAX_DEVIATIONS * variance)
        cosine = nx * near[k + _U(3) * block] + ny * near[k + _U(4) * block] + nz * near[k + _U(5) * block]
        weight = (1 - share) * (1 - share) * ((1 - deviation) * (1 - deviation)) / (other * other)
        used = (share < 1) & (deviation < 1) & (cosine >= 0.8)
        weighed[i] = weight if used else 0.0
        weighed[i + block] = height
        weighed[i + _U(2) * block] = (x * ux + y * uy + z * uz) / radius
        weighed[i + _U(3) * block] = (x * vx + y * vy + z * vz) / radius


@kernel(fastmath={"reassoc", "nsz"})  # so that the sums are vectorised
def add_block(weighed: FloatArray, count: int, a: FloatArray, b: FloatArray) -> int:
    """Add weighed neighbours to the normal equations of the plane h + s u + t v; return how many have a weight."""
    used = 0
    a0, a1, a2, a3, a4, a5, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(_U(count)):
        weight, height = weighed[i], weighed[i + _U(BLOCK)]
        u, v = weighed[i + _U(2 * BLOCK)], weighed[i + _U(3 * BLOCK)]
        along, across = weight * u, weight * v
        a0, a1, a2 = a0 + weight, a1 + along, a2 + across
        a3, a4, a5 = a3 + along * u, a4 + along * v, a5 + across * v
        b0, b1, b2 = b0 + weight * height, b1 + along * height, b2 + across * height
        used += weight > 0
    a[0], a[1], a[2], a[3], a[4], a[5] = a[0] + a0, a[1] + a1, a[2] + a2, a[3] + a3, a[4] + a4, a[5] + a5
    b[0], b[1], b[2] = b[0] + b0, b[1] + b1, b[2] + b2
    return used


@kernel
def find_heights(
    cloud: Cloud,
    radii: FloatArray,
    chosen: IntArray,
    cells: Cells,
    most: int,
    heights: FloatArray,
    part: tuple[int, int],
) -> None:
    """Write the heights of the surface above the points order[chosen[first:end]]; 0 where it is undefined.

    `cloud`: (N, 3) points, (N, 3) normals and (N,) standard deviations. `radii`: (N,) radius within which neighbours
    count. `chosen`: positions in the order of the cells of points, the radii of which are at most the edge of a cell.
    `cells`: keys of the occupied cells, where the points of each begin (and the last ends), (N,) the key of the cell of
    each point in order, the differences to the keys of the 9 columns of three cells around a cell, and the order of the
    points. `most`: number of points of a column that count, evenly among them. `heights`: (N,) written, along the
    normal. `part`: first and end.
    """
    points, normals, sigmas = cloud
    own, steps, order = cells[2], cells[3], cells[4]
    a, b, weighed = np.empty(6), np.empty(3), np.empty(4 * BLOCK)
    near = np.empty(((len(steps) * most + BLOCK - 1) // BLOCK) * 7 * BLOCK, np.float32)
    cell, neighbours = np.int64(-1), 0
    for number in range(part[0], part[1]):
        i = order[chosen[number]]
        if own[chosen[number]] != cell:  # successive points mostly lie in the same cell
            cell = own[chosen[number]]
            neighbours = gather_neighbours(cloud, cells, cell, most, near)
        axes = tangents(normals[i])
        point = points[i, 0], points[i, 1], points[i, 2], normals[i, 0], normals[i, 1], normals[i, 2], sigmas[i]
        a[:] = 0.0
        b[:] = 0.0
        count = 0
        for first in range(0, neighbours, BLOCK):
            inside = min(BLOCK, neighbours - first)
            weigh_block(near, first * 7, inside, point, axes, radii[i], weighed)
            count += add_block(weighed, inside, a, b)
        height, _, _, ok = solve_symmetric(a, b)
        is_central = a[1] * a[1] + a[2] * a[2] < _MAX_OFF_CENTER * _MAX_OFF_CENTER * a[0] * a[0]
        heights[i] = height if ok and count >= 6 and is_central else 0.0
