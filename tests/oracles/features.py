"""Slow, obvious versions of matching, and of SPHORB's grid and descriptors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray


def match_one_by_one(
    first: NDArray[Any], second: NDArray[Any], *, metric: str, ratio: float, mutual: bool
) -> list[tuple[int, int]]:
    def distances(descriptor: NDArray[Any], others: NDArray[Any]) -> NDArray[np.float64]:
        if metric == "l2":
            lengths: NDArray[np.float64] = np.sqrt(((others.astype(float) - descriptor.astype(float)) ** 2).sum(axis=1))
            return lengths
        bits: NDArray[np.uint8] = np.unpackbits(np.bitwise_xor(others, descriptor), axis=1)
        return np.asarray(bits.sum(axis=1), np.float64)

    found = []
    for i, descriptor in enumerate(first):
        row = distances(descriptor, second)
        j, next_best = np.argsort(row, kind="stable")[:2]
        if row[j] >= ratio * row[next_best]:
            continue
        if mutual and distances(second[j], first).min() < row[j]:
            continue
        found.append((i, int(j)))
    return found


# Unit steps to the six neighbours (v, u) with their directions.
STEPS = {(0, 1): 0, (1, 0): 60, (1, -1): 120, (0, -1): 180, (-1, 0): 240, (-1, 1): 300}


def plane_distance(row: float, column: float) -> float:
    return float(np.hypot(column + row / 2, row * np.sqrt(3) / 2))


def ring_of_three() -> list[tuple[int, int]]:
    """(row, column) of the cells that three steps lead to but two do not, by direction."""
    within = [{(0, 0)}]
    for _ in range(3):
        within.append({(r + dr, c + dc) for r, c in within[-1] for dr, dc in STEPS})
    ring = within[3] - within[2]
    return sorted(ring, key=lambda rc: np.arctan2(rc[0] * np.sqrt(0.75), rc[1] + rc[0] / 2) % (2 * np.pi) + 1e-12)


def segment_score(picture: NDArray[np.uint8], row: int, column: int, threshold: int) -> int:
    """The greatest t >= threshold at which ten in a row are all brighter by t, or all darker; 0 if none is greater."""
    ring = [int(picture[row + dr, column + dc]) - int(picture[row, column]) for dr, dc in ring_of_three()]
    best = 0
    for sign in (1, -1):
        for t in range(threshold + 1, 256):
            passes = [sign * d >= t for d in ring] * 2
            if any(all(passes[k : k + 10]) for k in range(18)):
                best = max(best, t)
    return best


def harris_response(picture: NDArray[np.uint8], row: int, column: int, *, radius: int, sigma: float) -> float:
    moments = np.zeros((2, 2))
    for dr in range(-radius, radius + 1):
        for dc in range(-radius, radius + 1):
            if abs(dr + dc) > radius:
                continue
            gradient = np.zeros(2)
            for (step_row, step_column), angle_deg in STEPS.items():
                direction = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
                gradient += direction * float(picture[row + dr + step_row, column + dc + step_column]) / 3
            weight = np.exp(-0.5 * plane_distance(dr, dc) ** 2 / sigma**2) / 255**2
            moments += weight * np.outer(gradient, gradient)
    return float(np.linalg.det(moments) - 0.04 * np.trace(moments) ** 2)


def disc_steps(radius: float) -> FloatArray:
    """Steps (x, y) in the tangent plane to the points of a hexagonal lattice within a radius."""
    reach = range(-2 * int(radius), 2 * int(radius) + 1)
    steps = [(c + r / 2, r * np.sqrt(3) / 2) for r in reach for c in reach if plane_distance(r, c) <= radius]
    return np.array(steps)


def between_cells(picture: NDArray[np.uint8], u: float, v: float) -> float:
    column, row = int(np.floor(u)), int(np.floor(v))
    return float(
        sum(
            float(picture[row + dr, column + dc]) * abs(1 - dr - (v - row)) * abs(1 - dc - (u - column))
            for dr in (0, 1)
            for dc in (0, 1)
        )
    )


def orientation(picture: NDArray[np.uint8], u: float, v: float, turn: FloatArray, *, radius: float) -> float:
    """The direction in the tangent plane from a place to the centroid of the disc around it."""
    centroid = np.zeros(2)
    for step in disc_steps(radius):
        column, row = np.floor(np.array([u, v]) + turn @ step + 0.5).astype(int)
        centroid += step * float(picture[row, column])
    return float(np.arctan2(centroid[1], centroid[0]))


def descriptor(
    picture: NDArray[np.uint8], u: float, v: float, turn: FloatArray, *, tests: FloatArray, angle: float
) -> FloatArray:
    """By how much the second place of each test is brighter than the first."""
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    values = [
        [between_cells(picture, *(np.array([u, v]) + turn @ rotation @ place)) for place in (test[:2], test[2:])]
        for test in tests
    ]
    return np.array([second - first for first, second in values])
