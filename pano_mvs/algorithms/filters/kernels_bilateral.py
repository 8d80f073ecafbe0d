"""Compiled: the bilateral grid on the sphere and the linear system of the Fast Bilateral Solver."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import inlined, kernel

# The arguments of `apply_system` after the values.
System = tuple[
    float,
    FloatArray,
    FloatArray,
    NDArray[np.int64],
    NDArray[np.int32],
    FloatArray,
    float,
    NDArray[np.int32],
    FloatArray,
]

_EMPTY = -1
# Colours are numbered within a cube of 128 bins per channel, of which the outermost stay empty.
COLOR_BINS = 128


@inlined
def _slot(key: int, bits: int) -> int:
    """Return the first slot to probe for a key in a table of 2^bits slots (multiplicative hashing without overflow)."""
    return int(((np.int64(key) % 2147483647 * 1640531527) >> 20) & ((1 << bits) - 1))


@kernel
def _find(table: NDArray[np.int64], numbers: NDArray[np.int32], key: int, bits: int) -> int:
    """Return the number of a key, or −1."""
    slot = _slot(key, bits)
    mask = (1 << bits) - 1
    while table[slot] != _EMPTY:
        if table[slot] == key:
            return int(numbers[slot])
        slot = (slot + 1) & mask
    return -1


@kernel
def _find_or_add(table: NDArray[np.int64], numbers: NDArray[np.int32], key: int, bits: int, count: int) -> int:
    """Return the number of a key; a new key gets the number `count`."""
    slot = _slot(key, bits)
    mask = (1 << bits) - 1
    while table[slot] != _EMPTY:
        if table[slot] == key:
            return int(numbers[slot])
        slot = (slot + 1) & mask
    table[slot] = key
    numbers[slot] = count
    return count


@inlined
def _bits_for(count: int) -> int:
    """Return the size of a table, as a power of two, that stays at most half full."""
    bits = 4
    while (1 << bits) < 2 * count:
        bits += 1
    return bits


@kernel
def number_elements(
    colors: NDArray[np.int64], cell_elements: NDArray[np.int32], gap_of_row: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the coloured element of each pixel, (H, W) int32, and the key of each, in order of appearance.

    A key is element · COLOR_BINS³ + colour.
    """
    height, width = colors.shape
    bits = _bits_for(height * width // 2)
    table, numbers = np.full(1 << bits, _EMPTY, np.int64), np.empty(1 << bits, np.int32)
    elements = np.empty((height, width), np.int32)
    keys = np.empty(height * width, np.int64)
    count = 0
    for row in range(height):
        gap = gap_of_row[row]
        last_key, last = np.int64(_EMPTY), np.int32(0)
        for column in range(width):
            key = np.int64(cell_elements[gap, column]) * COLOR_BINS**3 + colors[row, column]
            if key != last_key:
                if 4 * count > 3 << bits:
                    table, numbers, bits = _grow(keys, count, bits)
                last_key, last = key, _find_or_add(table, numbers, key, bits, count)
                if last == count:
                    keys[count] = key
                    count += 1
            elements[row, column] = last
    return elements, keys[:count].copy()


@kernel
def _grow(keys: NDArray[np.int64], count: int, bits: int) -> tuple[NDArray[np.int64], NDArray[np.int32], int]:
    """Return a table of twice the size that holds the same keys and numbers, and its bits."""
    bits += 1
    table, numbers = np.full(1 << bits, _EMPTY, np.int64), np.empty(1 << bits, np.int32)
    for number in range(count):
        _find_or_add(table, numbers, keys[number], bits, number)
    return table, numbers, bits


@kernel
def number_vertices(
    element_keys: NDArray[np.int64], corners: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the four vertices of each coloured element, (E, 4) int32, and the key cell · COLOR_BINS³ + colour."""
    count = len(element_keys)
    bits = _bits_for(4 * count)
    table, numbers = np.full(1 << bits, _EMPTY, np.int64), np.empty(1 << bits, np.int32)
    vertices = np.empty((count, 4), np.int32)
    keys = np.empty(4 * count, np.int64)
    used = 0
    for element in range(count):
        color = element_keys[element] % COLOR_BINS**3
        cell_element = element_keys[element] // COLOR_BINS**3
        for corner in range(4):
            key = np.int64(corners[cell_element, corner]) * COLOR_BINS**3 + color
            vertex = _find_or_add(table, numbers, key, bits, used)
            if vertex == used:
                keys[used] = key
                used += 1
            vertices[element, corner] = vertex
    return vertices, keys[:used].copy()


@kernel
def blur_graph(
    vertex_keys: NDArray[np.int64], starts: NDArray[np.int32], neighbours: NDArray[np.int32], strengths: FloatArray
) -> tuple[NDArray[np.int64], NDArray[np.int32], FloatArray]:
    """Return the neighbours of each vertex in space and in colour as compressed rows: starts, indices, strengths."""
    count = len(vertex_keys)
    bits = _bits_for(count)
    table, numbers = np.full(1 << bits, _EMPTY, np.int64), np.empty(1 << bits, np.int32)
    for vertex in range(count):
        _find_or_add(table, numbers, vertex_keys[vertex], bits, vertex)
    # Look up each edge from one end only: a look-up costs more than sorting the edges by their ends.
    heads, tails, values = np.empty(count * 9, np.int32), np.empty(count * 9, np.int32), np.empty(count * 9)
    used = 0
    for vertex in range(count):
        key = vertex_keys[vertex]
        cell, color = key // COLOR_BINS**3, key % COLOR_BINS**3
        for position in range(starts[cell], starts[cell + 1]):
            if neighbours[position] > cell:
                other = _find(table, numbers, np.int64(neighbours[position]) * COLOR_BINS**3 + color, bits)
                if other >= 0:
                    heads[used], tails[used], values[used] = vertex, other, strengths[position]
                    used += 1
        for step in (COLOR_BINS * COLOR_BINS, COLOR_BINS, 1):
            # The outermost bins of the cube are never used, so a step never wraps into the next row.
            other = _find(table, numbers, key + step, bits)
            if other >= 0:
                heads[used], tails[used], values[used] = vertex, other, 1.0
                used += 1
    rows: tuple[NDArray[np.int64], NDArray[np.int32], FloatArray] = _rows_from_edges(
        heads[:used], tails[:used], values[:used], count
    )
    return rows


@kernel
def _rows_from_edges(
    heads: NDArray[np.int32], tails: NDArray[np.int32], values: FloatArray, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int32], FloatArray]:
    """Return a symmetric graph as compressed rows: starts, indices, strengths."""
    starts = np.zeros(count + 1, np.int64)
    for edge in range(len(heads)):
        starts[heads[edge] + 1] += 1
        starts[tails[edge] + 1] += 1
    for vertex in range(count):
        starts[vertex + 1] += starts[vertex]
    free = starts[:-1].copy()
    indices, strengths = np.empty(2 * len(heads), np.int32), np.empty(2 * len(heads))
    for edge in range(len(heads)):
        for near, far in ((heads[edge], tails[edge]), (tails[edge], heads[edge])):
            indices[free[near]], strengths[free[near]] = far, values[edge]
            free[near] += 1
    return starts, indices, strengths


@inlined
def _corner_weights(weights: FloatArray, weight_row: float, upper: float, lower: float) -> None:
    weights[0] = (1 - weight_row) * (1 - upper)
    weights[1] = (1 - weight_row) * upper
    weights[2] = weight_row * (1 - lower)
    weights[3] = weight_row * lower


@kernel
def assemble(
    elements: NDArray[np.int32],
    targets: FloatArray,
    weights: FloatArray,
    count: int,
    gap_of_row: NDArray[np.int32],
    weight_row: FloatArray,
    weight_upper: FloatArray,
    weight_lower: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return, per coloured element, S 1 (E, 4), S C Sᵀ (E, 4, 4) and S C t (E, 4) restricted to its pixels."""
    height, width = elements.shape
    mass, gram, right = np.zeros((count, 4)), np.zeros((count, 4, 4)), np.zeros((count, 4))
    w = np.empty(4)
    for row in range(height):
        gap = gap_of_row[row]
        for column in range(width):
            element = elements[row, column]
            confidence, target = weights[row, column], targets[row, column]
            _corner_weights(w, weight_row[row], weight_upper[gap, column], weight_lower[gap, column])
            for a in range(4):
                mass[element, a] += w[a]
                cw = confidence * w[a]
                right[element, a] += cw * target
                for b in range(4):
                    gram[element, a, b] += cw * w[b]
    return mass, gram, right


@kernel
def sum_at_vertices(values: FloatArray, vertices: NDArray[np.int32], count: int) -> FloatArray:
    """Return the sum at each vertex, (V,), of the elements' corner values, (E, 4)."""
    result = np.zeros(count)
    for element in range(len(vertices)):
        for corner in range(4):
            result[vertices[element, corner]] += values[element, corner]
    return result


@kernel
def slice_pixels(
    elements: NDArray[np.int32],
    vertices: NDArray[np.int32],
    values: FloatArray,
    gap_of_row: NDArray[np.int32],
    weight_row: FloatArray,
    weight_upper: FloatArray,
    weight_lower: FloatArray,
) -> FloatArray:
    """Return Sᵀ values at each pixel, (H, W)."""
    height, width = elements.shape
    result = np.empty((height, width))
    w = np.empty(4)
    for row in range(height):
        gap = gap_of_row[row]
        for column in range(width):
            _corner_weights(w, weight_row[row], weight_upper[gap, column], weight_lower[gap, column])
            element = elements[row, column]
            total = 0.0
            for corner in range(4):
                total += w[corner] * values[vertices[element, corner]]
            result[row, column] = total
    return result


@kernel
def blur(
    values: FloatArray, starts: NDArray[np.int64], indices: NDArray[np.int32], strengths: FloatArray, center: float
) -> FloatArray:
    """Return B̄ values: `center` times each value plus the strengths times its neighbours' values."""
    result = np.empty_like(values)
    for vertex in range(len(values)):
        total = center * values[vertex]
        for position in range(starts[vertex], starts[vertex + 1]):
            total += strengths[position] * values[indices[position]]
        result[vertex] = total
    return result


@kernel
def bistochastise(
    mass: FloatArray,
    starts: NDArray[np.int64],
    indices: NDArray[np.int32],
    strengths: FloatArray,
    center: float,
    iterations: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the diagonals n and m of D_n and D_m (Barron and Poole, algorithm 1)."""
    n = np.ones_like(mass)
    for _ in range(iterations):
        blurred = blur(n, starts, indices, strengths, center)
        for vertex in range(len(n)):
            # Some corners receive no weight from any pixel; 0 / 0 there would make the whole solution NaN.
            n[vertex] = np.sqrt(n[vertex] * mass[vertex] / blurred[vertex]) if mass[vertex] > 0 else 0.0
    # Compute m from n instead of taking the mass: the rows of D_m − D_n B̄ D_n then sum to exactly zero.
    m = blur(n, starts, indices, strengths, center)
    for vertex in range(len(n)):
        m[vertex] *= n[vertex]
    return n, m


@kernel
def apply_system(
    values: FloatArray,
    smoothness: float,
    n: FloatArray,
    m: FloatArray,
    starts: NDArray[np.int64],
    indices: NDArray[np.int32],
    strengths: FloatArray,
    center: float,
    vertices: NDArray[np.int32],
    gram: FloatArray,
) -> FloatArray:
    """Return (λ (D_m − D_n B̄ D_n) + S C Sᵀ) values."""
    result = np.empty_like(values)
    for vertex in range(len(values)):
        result[vertex] = n[vertex] * values[vertex]
    blurred = blur(result, starts, indices, strengths, center)
    for vertex in range(len(values)):
        result[vertex] = smoothness * (m[vertex] * values[vertex] - n[vertex] * blurred[vertex])
    for element in range(len(vertices)):
        for a in range(4):
            total = 0.0
            for b in range(4):
                total += gram[element, a, b] * values[vertices[element, b]]
            result[vertices[element, a]] += total
    return result


@kernel
def solve(
    right: FloatArray, initial: FloatArray, diagonal: FloatArray, tolerance: float, iterations: int, system: System
) -> tuple[FloatArray, int]:
    """Return the solution by conjugate gradients with Jacobi preconditioning, and the number of iterations.

    `system` holds the arguments of `apply_system` after the values.
    """
    count = len(right)
    values, direction = initial.copy(), np.empty_like(right)
    residual = apply_system(values, *system)
    energy = square = 0.0
    for i in range(count):
        residual[i] = right[i] - residual[i]
        direction[i] = residual[i] / diagonal[i]
        energy += residual[i] * direction[i]
        square += right[i] * right[i] / diagonal[i]
    goal = tolerance**2 * square
    done = 0
    while done < iterations and energy > goal:
        image = apply_system(direction, *system)
        along = 0.0
        for i in range(count):
            along += direction[i] * image[i]
        step, previous, energy = energy / along, energy, 0.0
        for i in range(count):
            values[i] += step * direction[i]
            residual[i] -= step * image[i]
            image[i] = residual[i] / diagonal[i]
            energy += residual[i] * image[i]
        for i in range(count):
            direction[i] = image[i] + (energy / previous) * direction[i]
        done += 1
    return values, done
