"""Compiled: the height of the surface of a point's neighbours above the point."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pano_mvs.algorithms.fusion.kernels_normals import solve_symmetric

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Cloud = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
Cells = tuple[IntArray, IntArray, IntArray, IntArray]

_MIN_COSINE = 0.8
_MAX_DEVIATIONS = 2.5
_MAX_OFF_CENTER = 0.3
_MIN_NEIGHBOURS = 6


@njit(cache=True, error_model="numpy", nogil=True)
def column_range(keys: IntArray, starts: IntArray, key: int) -> tuple[int, int]:
    """Return where the points of a cell and of those before and behind it begin and end; their keys are successive."""
    first = int(np.searchsorted(keys, key - 1))
    end = first
    while end < len(keys) and keys[end] <= key + 1:
        end += 1
    return starts[first], starts[end]


@njit(cache=True, error_model="numpy", nogil=True)
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


@njit(cache=True, error_model="numpy", nogil=True)
def add_neighbour(cloud: Cloud, i: int, j: int, axes: FloatArray, radius: float, a: FloatArray, b: FloatArray) -> float:
    """Add point j to the normal equations of the plane h + s u + t v around point i; return its weight, 0 if unused."""
    points, normals, sigmas = cloud
    x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    height = float(x * normals[i, 0] + y * normals[i, 1] + z * normals[i, 2])
    share = (x * x + y * y + z * z - height * height) / (radius * radius)
    variance = sigmas[i] * sigmas[i] + sigmas[j] * sigmas[j]
    deviation = height * height / (_MAX_DEVIATIONS * _MAX_DEVIATIONS * variance)
    if share >= 1 or deviation >= 1:
        return 0.0
    cosine = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] + normals[i, 2] * normals[j, 2]
    if cosine < _MIN_COSINE:
        return 0.0
    u, v = x * axes[0] + y * axes[1] + z * axes[2], x * axes[3] + y * axes[4] + z * axes[5]
    weight: float = (1 - share) ** 2 * (1 - deviation) ** 2 / (sigmas[j] * sigmas[j])
    u, v = u / radius, v / radius
    a[0] += weight
    a[1] += weight * u
    a[2] += weight * v
    a[3] += weight * u * u
    a[4] += weight * u * v
    a[5] += weight * v * v
    b[0] += weight * height
    b[1] += weight * height * u
    b[2] += weight * height * v
    return weight


@njit(cache=True, error_model="numpy", nogil=True)
def find_heights(
    cloud: Cloud,
    radii: FloatArray,
    chosen: IntArray,
    cells: Cells,
    most: int,
    heights: FloatArray,
    part: tuple[int, int],
) -> None:
    """Write the heights of the surface above the points chosen[first:end]; 0 where it is undefined.

    Args:
        cloud: (N, 3) points, (N, 3) normals and (N,) standard deviations, sorted by cells.
        radii: (N,) radius within which neighbours count.
        chosen: indices of points, the radii of which are at most the edge of a cell.
        cells: keys of the occupied cells, where the points of each begin (and the last ends), (N,) the key of the cell
            of each point, and the differences to the keys of the 9 columns of three cells around a cell.
        most: number of points of a column that count, evenly among them.
        heights: (N,) written, along the normal.
        part: first and end.
    """
    keys, starts, own, steps = cells
    a, b, axes = np.empty(6), np.empty(3), np.empty(6)
    columns = np.empty((len(steps), 2), np.int64)
    cell = np.int64(-1)
    for number in range(part[0], part[1]):
        i = chosen[number]
        if own[i] != cell:  # successive points mostly lie in the same cell
            cell = own[i]
            for c in range(len(steps)):
                columns[c, 0], columns[c, 1] = column_range(keys, starts, cell + steps[c])
        axes[0], axes[1], axes[2], axes[3], axes[4], axes[5] = tangents(cloud[1][i])
        a[:] = 0.0
        b[:] = 0.0
        count = 0
        for c in range(len(steps)):
            begin, end = columns[c, 0], columns[c, 1]
            inside = min(end - begin, most)
            for k in range(inside):
                j = begin + k * (end - begin) // inside
                if add_neighbour(cloud, i, j, axes, radii[i], a, b) > 0:
                    count += 1
        height, _, _, ok = solve_symmetric(a, b)
        off_center = (a[1] * a[1] + a[2] * a[2]) / (_MAX_OFF_CENTER * _MAX_OFF_CENTER * a[0] * a[0])
        heights[i] = height if ok and count >= _MIN_NEIGHBOURS and off_center < 1 else 0.0
