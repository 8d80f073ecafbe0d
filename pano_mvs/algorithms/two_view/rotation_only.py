"""The pure rotation that most matches agree on: both pictures taken from one place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import angle_between, nearest_rotation

FloatArray = NDArray[np.float64]

_SAMPLES = 200


def estimate_rotation(
    first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return second_from_first's rotation, (3, 3), without translation, and which matches agree with it, (M,).

    Two-point samples, then the least-squares rotation of the inliers (Kabsch).

    Args:
        first: (M, 3) unit bearings, M ≥ 2.
        second: (M, 3) unit bearings.
        rng: draws the samples.
        threshold_rad: angle between the turned and the seen ray below which a match agrees.
    """
    samples = rng.integers(len(first), size=(_SAMPLES, 2))
    rotations = nearest_rotation(np.swapaxes(second[samples], 1, 2) @ first[samples])
    squared_chord = (2 * np.sin(threshold_rad / 2)) ** 2
    # |q − R p|² = 2 − 2 q·R p, and q·R p is one matrix product for all samples.
    products = (second[:, :, None] * first[:, None, :]).reshape(-1, 9)
    agreeing = (2 - 2 * rotations.reshape(-1, 9) @ products.T < squared_chord).sum(axis=1)
    rotation = rotations[np.argmax(agreeing)]
    for _ in range(4):
        inliers = angle_between(first @ rotation.T, second) < threshold_rad
        if inliers.sum() < 2:
            break
        rotation = nearest_rotation(second[inliers].T @ first[inliers])
    return rotation, angle_between(first @ rotation.T, second) < threshold_rad
