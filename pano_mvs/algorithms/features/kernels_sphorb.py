"""Compiled: corners on a triangular lattice, their responses and positions, and their binary descriptors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import bilinear


@kernel
def segment_score(differences: NDArray[np.int64]) -> np.int64:
    """Return the greatest threshold at which an arc of a ring (18,) int64 is entirely brighter or entirely darker."""
    best = np.int64(0)
    for start in range(18):
        brighter, darker = np.int64(255), np.int64(255)
        for step in range(10):
            difference = differences[(start + step) % 18]
            brighter = min(brighter, difference)
            darker = min(darker, -difference)
        best = max(best, max(brighter, darker))
    return best


@kernel
def score_corners(
    pictures: NDArray[np.uint8],
    ring: NDArray[np.int64],
    margin: int,
    reach: int,
    threshold: int,
    scores: NDArray[np.uint8],
) -> None:
    """Write the segment test's score at every cell of the faces and `reach` cells beyond, 0 where it fails.

    Args:
        pictures: (20, side, side) uint8.
        ring: (18,) int64 offsets of the ring in a flat face.
        margin: cells of the array beyond the face.
        reach: number of cells beyond the face to score.
        threshold: a difference must be greater.
        scores: (20, side, side) uint8, all 0; written.
    """
    side = pictures.shape[1]
    steps = side - 1 - 2 * margin
    differences = np.empty(18, np.int64)
    for face in range(pictures.shape[0]):
        picture, score = pictures[face].reshape(-1), scores[face].reshape(-1)
        for v in range(-reach, steps + reach + 1):
            for u in range(-reach, steps + reach - v + 1):
                at = (v + margin) * side + u + margin
                center = np.int64(picture[at])
                low, high = center - threshold, center + threshold
                # An arc of ten of the eighteen cells contains at least one of any two opposite cells.
                a, b = np.int64(picture[at + ring[0]]), np.int64(picture[at + ring[9]])
                c, d = np.int64(picture[at + ring[4]]), np.int64(picture[at + ring[13]])
                brighter = (a > high or b > high) and (c > high or d > high)
                darker = (a < low or b < low) and (c < low or d < low)
                if not (brighter or darker):
                    continue
                for k in range(18):
                    differences[k] = np.int64(picture[at + ring[k]]) - center
                found = segment_score(differences)
                if found > threshold:
                    score[at] = found


@kernel
def local_maxima(
    scores: NDArray[np.uint8], neighbours: NDArray[np.int64], margin: int, reach: int, cells: NDArray[np.int64]
) -> int:
    """Write the cells, (face, v, u), whose score is greatest among their six neighbours; return their number.

    Args:
        scores: (20, side, side) uint8.
        neighbours: (6,) int64 offsets in a flat face; of two equal neighbours, the one earlier in memory is kept.
        margin: cells of the array beyond the face.
        reach: cells beyond the face to be searched.
        cells: (N, 3) int64, written; further maxima are dropped.
    """
    side = scores.shape[1]
    steps = side - 1 - 2 * margin
    count = 0
    for face in range(scores.shape[0]):
        score = scores[face].reshape(-1)
        for v in range(-reach, steps + reach + 1):
            for u in range(-reach, steps + reach - v + 1):
                at = (v + margin) * side + u + margin
                own = score[at]
                if own == 0:
                    continue
                greatest = True
                for k in range(6):
                    other = score[at + neighbours[k]]
                    if other > own or (other == own and neighbours[k] < 0):
                        greatest = False
                if greatest and count < len(cells):
                    cells[count, 0], cells[count, 1], cells[count, 2] = face, v, u
                    count += 1
    return count


@kernel
def harris_response(
    picture: NDArray[np.uint8], at: int, side: int, window: NDArray[np.int64], weights: FloatArray
) -> float:
    """Return det M − 0.04 tr² M at a cell of a flat picture, M the weighted sum of the gradients' squares.

    The gradient is Σ d_k I_k / 3 over the unit steps d_k to the six neighbours.
    """
    xx, xy, yy = 0.0, 0.0, 0.0
    for k in range(len(window)):
        c = at + window[k]
        east, west = np.float64(picture[c + 1]), np.float64(picture[c - 1])
        upper_east, lower_west = np.float64(picture[c + side]), np.float64(picture[c - side])
        upper_west, lower_east = np.float64(picture[c + side - 1]), np.float64(picture[c - side + 1])
        x = (east - west + 0.5 * (upper_east + lower_east - upper_west - lower_west)) / 3
        y = (upper_east + upper_west - lower_east - lower_west) * (math.sqrt(0.75) / 3)
        xx += weights[k] * x * x
        xy += weights[k] * x * y
        yy += weights[k] * y * y
    return xx * yy - xy * xy - 0.04 * (xx + yy) ** 2


@kernel
def hexagon_peak(center: float, around: FloatArray) -> tuple[float, float]:
    """Return lattice steps (u, v) from a cell to the maximum of the paraboloid through it and its six neighbours (6,).

    Returns (0, 0) if the paraboloid has no maximum within one step.
    """
    diagonal = math.sqrt(0.75)
    gx = (around[0] - around[3] + 0.5 * (around[1] + around[5] - around[2] - around[4])) / 3
    gy = diagonal * (around[1] + around[2] - around[4] - around[5]) / 3
    total = around[0] + around[1] + around[2] + around[3] + around[4] + around[5]
    trace = 4 * (total / 6 - center)
    stretch = 4 / 3 * (around[0] + around[3] - 0.5 * (around[1] + around[2] + around[4] + around[5]))
    xy = 2 / 3 * diagonal * (around[1] + around[4] - around[2] - around[5])
    xx, yy = 0.5 * (trace + stretch), 0.5 * (trace - stretch)
    determinant = xx * yy - xy * xy
    if not (determinant > 0 and xx < 0):
        return 0.0, 0.0
    x, y = -(yy * gx - xy * gy) / determinant, -(xx * gy - xy * gx) / determinant
    if x * x + y * y > 1:
        return 0.0, 0.0
    return x - y / math.sqrt(3.0), y * 2 / math.sqrt(3.0)


@kernel
def refine_corners(
    pictures: NDArray[np.uint8],
    cells: NDArray[np.int64],
    window: NDArray[np.int64],
    weights: FloatArray,
    neighbours: NDArray[np.int64],
    margin: int,
    places: FloatArray,
    responses: FloatArray,
) -> None:
    """Move corners to the nearest peak of the Harris response, at most two cells away, with subcell precision.

    Args:
        pictures: (20, side, side) uint8.
        cells: (N, 3) int64, (face, v, u).
        window: (K,) int64 offsets in a flat face, over which gradients are summed.
        weights: (K,) float64.
        neighbours: (6,) int64 offsets in a flat face, in order around the cell.
        margin: cells of the array beyond the face.
        places: (N, 2) float64 lattice coordinates (u, v); written.
        responses: (N,) float64; written.
    """
    side = pictures.shape[1]
    around = np.empty(6)
    for n in range(len(cells)):
        picture = pictures[cells[n, 0]].reshape(-1)
        at = (cells[n, 1] + margin) * side + cells[n, 2] + margin
        center = harris_response(picture, at, side, window, weights)
        for _ in range(3):
            best = 0
            for k in range(6):
                around[k] = harris_response(picture, at + neighbours[k], side, window, weights)
                if around[k] > around[best]:
                    best = k
            if around[best] <= center or _ == 2:
                break
            at += neighbours[best]
            center = around[best]
        u, v = hexagon_peak(center, around)
        places[n, 0], places[n, 1] = at % side - margin + u, at // side - margin + v
        responses[n] = center


@kernel
def disc_is_clear(
    valid: NDArray[np.uint8],
    faces: NDArray[np.int64],
    places: FloatArray,
    lattice_from_tangent: FloatArray,
    disc: FloatArray,
    margin: int,
    clear: NDArray[np.bool_],
) -> None:
    """Write whether all cells of a disc in the tangent plane around each position are valid.

    Args:
        valid: (20, side, side) uint8, 0 where masked.
        faces: (N,) int64.
        places: (N, 2) float64 lattice coordinates.
        lattice_from_tangent: (N, 2, 2) float64.
        disc: (K, 2) float64 steps in the tangent plane.
        margin: cells of the array beyond the face.
        clear: (N,) bool; written.
    """
    for n in range(len(faces)):
        turn = lattice_from_tangent[n]
        clear[n] = True
        for k in range(len(disc)):
            x, y = disc[k, 0], disc[k, 1]
            column = math.floor(places[n, 0] + turn[0, 0] * x + turn[0, 1] * y + 0.5) + margin
            row = math.floor(places[n, 1] + turn[1, 0] * x + turn[1, 1] * y + 0.5) + margin
            if valid[faces[n], row, column] == 0:
                clear[n] = False
                break


@kernel
def sample_lattice(picture: NDArray[np.uint8], u: float, v: float) -> float:
    """Return the bilinear value of a picture (side, side) at column u and row v."""
    column, row = math.floor(u), math.floor(v)
    upper_left, upper_right = picture[row, column], picture[row, column + 1]
    lower_left, lower_right = picture[row + 1, column], picture[row + 1, column + 1]
    value: float = bilinear(upper_left, upper_right, lower_left, lower_right, u - column, v - row)
    return value


@kernel
def describe_corners(
    pictures: NDArray[np.uint8],
    faces: NDArray[np.int64],
    places: FloatArray,
    lattice_from_tangent: FloatArray,
    disc: FloatArray,
    tests: FloatArray,
    margin: int,
    angles: FloatArray,
    bits: NDArray[np.uint8],
) -> None:
    """Write each corner's orientation (the direction of its disc's intensity centroid) and its rotated binary tests.

    Args:
        pictures: (20, side, side) uint8, smoothed.
        faces: (N,) int64.
        places: (N, 2) float64 lattice coordinates (u, v).
        lattice_from_tangent: (N, 2, 2) float64.
        disc: (K, 2) float64 steps in the tangent plane.
        tests: (8 B, 4) float64 steps (x, y) of the first and the second point of each test.
        margin: cells of the array beyond the face.
        angles: (N,) float64; written.
        bits: (N, B) uint8; bit i of byte j is test 8 j + i: 1 if the first point is darker. Written.
    """
    for n in range(len(faces)):
        picture, turn = pictures[faces[n]], lattice_from_tangent[n]
        u, v = places[n, 0] + margin, places[n, 1] + margin
        moment_x, moment_y = 0.0, 0.0
        for k in range(len(disc)):
            x, y = disc[k, 0], disc[k, 1]
            column = math.floor(u + turn[0, 0] * x + turn[0, 1] * y + 0.5)
            row = math.floor(v + turn[1, 0] * x + turn[1, 1] * y + 0.5)
            value = np.float64(picture[row, column])
            moment_x += x * value
            moment_y += y * value
        angles[n] = math.atan2(moment_y, moment_x)
        cosine, sine = math.cos(angles[n]), math.sin(angles[n])
        # Lattice steps of the turned axes.
        uu, uv = turn[0, 0] * cosine + turn[0, 1] * sine, turn[0, 1] * cosine - turn[0, 0] * sine
        vu, vv = turn[1, 0] * cosine + turn[1, 1] * sine, turn[1, 1] * cosine - turn[1, 0] * sine
        for j in range(bits.shape[1]):
            byte = 0
            for i in range(8):
                test = tests[8 * j + i]
                first = sample_lattice(picture, u + uu * test[0] + uv * test[1], v + vu * test[0] + vv * test[1])
                second = sample_lattice(picture, u + uu * test[2] + uv * test[3], v + vu * test[2] + vv * test[3])
                if first < second:
                    byte |= 1 << i
            bits[n, j] = byte
