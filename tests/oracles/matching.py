"""Nearest-neighbour matching, one descriptor at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


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
