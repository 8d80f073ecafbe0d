"""Compiled: agreement of matches with essential matrices and relative poses.

The cost of a match is min(r² / threshold², 1) with the squared Sampson error r² = e² / D. For a pose with |t| = 1 and
a = R p: e = t · (a × q), D = 2 − (t·a)² − (t·q)² − 2 e². With c = a·q the rays meet in front of both cameras where
t·a < c t·q and c t·a < t·q; if the angle between a and q is below twice the threshold, noise decides.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import inlined, kernel


@kernel
def _squared_error(e: FloatArray, p: FloatArray, q: FloatArray) -> tuple[float, float]:
    """Return the numerator and denominator of the squared Sampson error for an essential matrix."""
    x = e[0, 0] * p[0] + e[0, 1] * p[1] + e[0, 2] * p[2]
    y = e[1, 0] * p[0] + e[1, 1] * p[1] + e[1, 2] * p[2]
    z = e[2, 0] * p[0] + e[2, 1] * p[1] + e[2, 2] * p[2]
    u = e[0, 0] * q[0] + e[1, 0] * q[1] + e[2, 0] * q[2]
    v = e[0, 1] * q[0] + e[1, 1] * q[1] + e[2, 1] * q[2]
    w = e[0, 2] * q[0] + e[1, 2] * q[1] + e[2, 2] * q[2]
    algebraic = x * q[0] + y * q[1] + z * q[2]
    squared = algebraic * algebraic
    return squared, max(x * x + y * y + z * z + u * u + v * v + w * w - 2.0 * squared, 1e-300)


@kernel
def _essential_cost(
    essential: FloatArray, first: FloatArray, second: FloatArray, squared_threshold: float, limit: float, sigmas: float
) -> float:
    """Return the cost of all matches, or infinity once it reaches the limit or most likely will."""
    count = len(first)
    mean = limit / count
    total = 0.0
    for idx in range(count):
        squared, scale = _squared_error(essential, first[idx], second[idx])
        allowed = squared_threshold * scale
        total += squared / allowed if squared < allowed else 1.0
        if total >= limit:
            return np.inf
        seen = idx + 1
        # After these numbers of matches, a hypothesis that lags too far behind is dropped.
        if mean < 1.0 and seen in (16, 32, 64, 128):
            if total > seen * mean + sigmas * math.sqrt(seen * mean * (1.0 - mean)):
                return np.inf
    return total


@kernel
def rank_essentials(
    essentials: FloatArray,
    first: FloatArray,
    second: FloatArray,
    threshold: float,
    limit: float,
    sigmas: float,
    best: NDArray[np.int64],
    costs: FloatArray,
) -> None:
    """Write the essential matrices with the lowest costs, in ascending order of cost.

    Args:
        essentials: (N, 3, 3).
        first: (M, 3) unit bearings in random order: the first few stand for all.
        second: (M, 3) unit bearings.
        threshold: in radians.
        limit: costs of at least this are ignored.
        sigmas: standard deviations by which the cost of a hypothesis may exceed the best after some matches.
        best: (K,) int64, written: positions in `essentials`, -1 if there are fewer.
        costs: (K,) float64, written, infinity if there are fewer.
    """
    best[:] = -1
    costs[:] = np.inf
    last = len(best) - 1
    for n in range(len(essentials)):
        bound = min(limit, costs[last])
        cost = _essential_cost(essentials[n], first, second, threshold * threshold, bound, sigmas)
        if cost >= bound:
            continue
        row = last
        while row > 0 and costs[row - 1] > cost:
            costs[row], best[row] = costs[row - 1], best[row - 1]
            row -= 1
        costs[row], best[row] = cost, n


@inlined
def epipolar(rotation: FloatArray, t: FloatArray, p: FloatArray, q: FloatArray) -> tuple[float, ...]:
    """Return e and D of the Sampson error e / √D of a match, see `kernels_refinement`, q · a, t · a and t · q."""
    a0 = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2]
    a1 = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2]
    a2 = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2]
    e = t[0] * (a1 * q[2] - a2 * q[1]) + t[1] * (a2 * q[0] - a0 * q[2]) + t[2] * (a0 * q[1] - a1 * q[0])
    along_a = t[0] * a0 + t[1] * a1 + t[2] * a2
    along_q = t[0] * q[0] + t[1] * q[1] + t[2] * q[2]
    squared = 2.0 - along_a * along_a - along_q * along_q - 2.0 * e * e
    return e, squared, a0 * q[0] + a1 * q[1] + a2 * q[2], along_a, along_q


@kernel
def pose_residuals(
    rotation: FloatArray,
    t: FloatArray,
    first: FloatArray,
    second: FloatArray,
    threshold: float,
    residuals: FloatArray,
    agreeing: NDArray[np.bool_],
) -> None:
    """Write the Sampson error of each match, and whether it agrees: a small error, and in front of both cameras."""
    far = math.cos(2.0 * threshold)
    for idx in range(len(first)):
        p, q = first[idx], second[idx]
        e, squared, cosine, along_a, along_q = epipolar(rotation, t, p, q)
        residuals[idx] = abs(e) / math.sqrt(max(squared, 1e-300))
        front = along_a < cosine * along_q and cosine * along_a < along_q
        agreeing[idx] = residuals[idx] < threshold and (front or cosine > far)


@kernel
def pose_cost(rotation: FloatArray, t: FloatArray, first: FloatArray, second: FloatArray, threshold: float) -> float:
    """Return the cost of all matches for a pose; a match behind a camera costs 1."""
    far = math.cos(2.0 * threshold)
    squared_threshold = threshold * threshold
    total = 0.0
    for idx in range(len(first)):
        p, q = first[idx], second[idx]
        e, squared, cosine, along_a, along_q = epipolar(rotation, t, p, q)
        allowed = squared_threshold * max(squared, 1e-300)
        if e * e >= allowed:
            total += 1.0
            continue
        front = along_a < cosine * along_q and cosine * along_a < along_q
        total += e * e / allowed if front or cosine > far else 1.0
    return total


@kernel
def direction_costs(
    rotated: FloatArray, second: FloatArray, directions: FloatArray, threshold: float, costs: FloatArray
) -> None:
    """Write the costs of each direction and of its opposite, (N, 2), given the rotation.

    Args:
        rotated: (M, 3) bearings of the first image turned into the second.
        second: (M, 3) unit bearings.
        directions: (N, 3) unit translations.
        threshold: in radians.
        costs: (N, 2) float64, written.
    """
    far = math.cos(2.0 * threshold)
    squared_threshold = threshold * threshold
    count = len(second)
    normals, cosines = np.empty((count, 3)), np.empty(count)
    for idx in range(count):
        a, q = rotated[idx], second[idx]
        normals[idx, 0] = a[1] * q[2] - a[2] * q[1]
        normals[idx, 1] = a[2] * q[0] - a[0] * q[2]
        normals[idx, 2] = a[0] * q[1] - a[1] * q[0]
        cosines[idx] = a[0] * q[0] + a[1] * q[1] + a[2] * q[2]
    for n in range(len(directions)):
        t = directions[n]
        forward, backward = float(count), float(count)
        for idx in range(count):
            e = t[0] * normals[idx, 0] + t[1] * normals[idx, 1] + t[2] * normals[idx, 2]
            if e * e >= 2.0 * squared_threshold:
                continue
            a, q = rotated[idx], second[idx]
            along_a = t[0] * a[0] + t[1] * a[1] + t[2] * a[2]
            along_q = t[0] * q[0] + t[1] * q[1] + t[2] * q[2]
            allowed = squared_threshold * max(2.0 - along_a * along_a - along_q * along_q - 2.0 * e * e, 1e-300)
            if e * e >= allowed:
                continue
            gain = 1.0 - e * e / allowed
            to_a, to_q = along_a - cosines[idx] * along_q, cosines[idx] * along_a - along_q
            if cosines[idx] > far or (to_a < 0.0 and to_q < 0.0):
                forward -= gain
            if cosines[idx] > far or (to_a > 0.0 and to_q > 0.0):
                backward -= gain
        costs[n, 0], costs[n, 1] = forward, backward


@kernel
def _rotation_of(essential: FloatArray, t: FloatArray, sign: float, rotation: FloatArray) -> None:
    """Write the rotation of E = ±[t]× R, made orthonormal row by row.

    With |t| = 1 it is cof(E) ∓ [t]× E (Horn 1990, "Recovering baseline and orientation from essential matrix").
    """
    e = essential
    for row in range(3):
        i, j = (row + 1) % 3, (row + 2) % 3
        for column in range(3):
            k, m = (column + 1) % 3, (column + 2) % 3
            cofactor = e[i, k] * e[j, m] - e[i, m] * e[j, k]
            rotation[row, column] = cofactor - sign * (t[i] * e[j, column] - t[j] * e[i, column])
    r = rotation
    length = math.sqrt(r[0, 0] * r[0, 0] + r[0, 1] * r[0, 1] + r[0, 2] * r[0, 2])
    for column in range(3):
        r[0, column] /= length
    along = r[0, 0] * r[1, 0] + r[0, 1] * r[1, 1] + r[0, 2] * r[1, 2]
    for column in range(3):
        r[1, column] -= along * r[0, column]
    length = math.sqrt(r[1, 0] * r[1, 0] + r[1, 1] * r[1, 1] + r[1, 2] * r[1, 2])
    for column in range(3):
        r[1, column] /= length
    for column in range(3):
        k, m = (column + 1) % 3, (column + 2) % 3
        r[2, column] = r[0, k] * r[1, m] - r[0, m] * r[1, k]


@kernel
def decompose_facing(
    essential: FloatArray, first: FloatArray, second: FloatArray, threshold: float, rotation: FloatArray, t: FloatArray
) -> None:
    """Write the decomposition of an essential matrix of norm √2 with the most inliers in front of both cameras."""
    # t is normal to all columns; the longest cross product of two of them is the most accurate.
    longest = -1.0
    normal = np.empty(3)
    for column in range(3):
        other = (column + 1) % 3
        x = essential[1, column] * essential[2, other] - essential[2, column] * essential[1, other]
        y = essential[2, column] * essential[0, other] - essential[0, column] * essential[2, other]
        z = essential[0, column] * essential[1, other] - essential[1, column] * essential[0, other]
        squared = x * x + y * y + z * z
        if squared > longest:
            longest = squared
            normal[0], normal[1], normal[2] = x, y, z
    length = math.sqrt(longest)
    for i in range(3):
        normal[i] /= length
    rotations = np.empty((2, 3, 3))
    _rotation_of(essential, normal, 1.0, rotations[0])
    _rotation_of(essential, normal, -1.0, rotations[1])
    fronts = np.zeros(4, np.int64)
    for idx in range(len(first)):
        p, q = first[idx], second[idx]
        squared, scale = _squared_error(essential, p, q)
        if squared >= threshold * threshold * scale:
            continue
        along_q = normal[0] * q[0] + normal[1] * q[1] + normal[2] * q[2]
        for which in range(2):
            r = rotations[which]
            a0 = r[0, 0] * p[0] + r[0, 1] * p[1] + r[0, 2] * p[2]
            a1 = r[1, 0] * p[0] + r[1, 1] * p[1] + r[1, 2] * p[2]
            a2 = r[2, 0] * p[0] + r[2, 1] * p[1] + r[2, 2] * p[2]
            along_a = normal[0] * a0 + normal[1] * a1 + normal[2] * a2
            cosine = a0 * q[0] + a1 * q[1] + a2 * q[2]
            to_a, to_q = along_a - cosine * along_q, cosine * along_a - along_q
            if to_a < 0.0 and to_q < 0.0:
                fronts[2 * which] += 1
            if to_a > 0.0 and to_q > 0.0:
                fronts[2 * which + 1] += 1
    chosen = 0
    for n in range(1, 4):
        if fronts[n] > fronts[chosen]:
            chosen = n
    for i in range(3):
        t[i] = normal[i] if chosen % 2 == 0 else -normal[i]
        for j in range(3):
            rotation[i, j] = rotations[chosen // 2, i, j]


@kernel
def count_chance(
    rotation: FloatArray,
    t: FloatArray,
    first: FloatArray,
    second: FloatArray,
    pairs: NDArray[np.int64],
    threshold: float,
) -> tuple[int, int]:
    """Return how many pairs (N, 2) of different matches agree with their rays swapped, and the number of such pairs."""
    squared_threshold = threshold * threshold
    agreeing, drawn = 0, 0
    for n in range(len(pairs)):
        if pairs[n, 0] == pairs[n, 1]:
            continue
        drawn += 1
        p, q = first[pairs[n, 0]], second[pairs[n, 1]]
        e, squared, cosine, along_a, along_q = epipolar(rotation, t, p, q)
        allowed = squared_threshold * max(squared, 1e-300)
        if e * e < allowed and along_a < cosine * along_q and cosine * along_a < along_q:
            agreeing += 1
    return agreeing, drawn


@kernel
def best_turn(
    first: FloatArray, second: FloatArray, samples: NDArray[np.int64], squared_chord: float, rotation: FloatArray
) -> None:
    """Write the rotation, of those through the pairs of matches (N, 2), with which most matches agree.

    The frames (a + b, a − b, their product) of two rays correspond in the least-squares sense.
    """
    most = -1
    frames = np.empty((2, 3, 3))
    turn = np.empty((3, 3))
    for n in range(len(samples)):
        regular = True
        for side in range(2):
            rays = first if side == 0 else second
            a, b = rays[samples[n, 0]], rays[samples[n, 1]]
            frame = frames[side]
            for i in range(3):  # numba compiles expressions of arrays with all texts of their errors: 4 CPU-s
                frame[0, i], frame[1, i] = a[i] + b[i], a[i] - b[i]
            for row in range(2):
                length = math.sqrt(frame[row, 0] ** 2 + frame[row, 1] ** 2 + frame[row, 2] ** 2)
                regular = regular and length > 1e-6
                for i in range(3):
                    frame[row, i] /= max(length, 1e-300)
            x, y = frame[0], frame[1]
            frame[2, 0] = x[1] * y[2] - x[2] * y[1]
            frame[2, 1] = x[2] * y[0] - x[0] * y[2]
            frame[2, 2] = x[0] * y[1] - x[1] * y[0]
        if not regular:
            continue
        for i in range(3):
            for j in range(3):
                turn[i, j] = (
                    frames[1, 0, i] * frames[0, 0, j]
                    + frames[1, 1, i] * frames[0, 1, j]
                    + frames[1, 2, i] * frames[0, 2, j]
                )
        agreeing = 0
        for idx in range(len(first)):
            if agreeing + len(first) - idx <= most:
                break
            p, q = first[idx], second[idx]
            squared = 0.0
            for i in range(3):
                squared += (q[i] - turn[i, 0] * p[0] - turn[i, 1] * p[1] - turn[i, 2] * p[2]) ** 2
            if squared < squared_chord:
                agreeing += 1
        if agreeing > most:
            most = agreeing
            for i in range(3):
                for j in range(3):
                    rotation[i, j] = turn[i, j]
