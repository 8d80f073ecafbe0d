"""Robust estimation of a pure rotation, for images taken from the same place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import angle_between, nearest_rotation


def estimate_rotation(
    first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Estimate second_from_first's rotation, (3, 3), without translation, and its inliers, (M,).

    Two-point samples, then the least-squares rotation of the inliers (Kabsch).

    Args:
        first: (M, 3) unit bearings, M ≥ 2.
        second: (M, 3) unit bearings.
        rng: draws the samples.
        threshold_rad: maximum angle between the rotated and the observed ray of an inlier.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import best_turn

    samples = rng.integers(len(first), size=(200, 2))
    rotation = np.eye(3)
    squared_chord = (2 * np.sin(threshold_rad / 2)) ** 2
    best_turn(np.ascontiguousarray(first), np.ascontiguousarray(second), samples, squared_chord, rotation)
    for _ in range(4):
        inliers = angle_between(first @ rotation.T, second) < threshold_rad
        if inliers.sum() < 2:
            break
        rotation = nearest_rotation(second[inliers].T @ first[inliers])
    return rotation, angle_between(first @ rotation.T, second) < threshold_rad
