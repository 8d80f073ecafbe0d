"""Select key points: distinct ones, spread evenly over the sphere."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import Setting

MaxKeypoints: TypeAlias = Annotated[int, Setting("maximum number, spread over the sphere by strength", ge=8)]


def distinct_keypoints(bearings: FloatArray, scores: NDArray[np.float32], *, radius_rad: float) -> NDArray[np.intp]:
    """Return the positions of key points without a stronger one within a radius; of equals, the first is kept.

    Args:
        bearings: (N, 3) unit vectors.
        scores: (N,) strength.
        radius_rad: angular radius.
    """
    order = np.argsort(-scores, kind="stable")
    if not len(order):
        return order
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    pairs = scipy.spatial.cKDTree(bearings).query_pairs(2 * np.sin(radius_rad / 2), output_type="ndarray")
    weaker, stronger = np.sort(rank[pairs], axis=1)[:, ::-1].T
    kept = np.ones(len(order), np.bool_)
    # In order of strength of the weaker one, so that the decision on the stronger one has already been made.
    for pair in np.lexsort((stronger, weaker)):
        if kept[stronger[pair]]:
            kept[weaker[pair]] = False
    return np.sort(order[kept])


def spread_keypoints(bearings: FloatArray, scores: NDArray[np.float32], *, max_keypoints: int) -> NDArray[np.intp]:
    """Return the positions of at most `max_keypoints` key points, strongest first, spread over cells of equal area.

    Every cell gives its best key point, then its second best, and so on, until there are enough.

    Args:
        bearings: (N, 3) unit vectors.
        scores: (N,) strength.
        max_keypoints: maximum number of key points.
    """
    order = np.argsort(-scores, kind="stable")
    if len(order) <= max_keypoints:
        return order
    # Directions that are spread nearly evenly, on a Fibonacci spiral.
    count = max(20, max_keypoints // 8)
    idx = np.arange(count) + 0.5
    y = 1 - 2 * idx / count
    azimuth = np.pi * (1 + np.sqrt(5)) * idx
    radius = np.sqrt(1 - y**2)
    cells = np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=1)
    cell = np.asarray(scipy.spatial.cKDTree(cells).query(bearings[order])[1], np.intp)
    by_cell = np.argsort(cell, kind="stable")
    first_of_cell = np.searchsorted(cell[by_cell], np.arange(len(cells)))
    rank = np.empty(len(order), np.intp)
    rank[by_cell] = np.arange(len(order)) - first_of_cell[cell[by_cell]]
    chosen = np.sort(np.argsort(rank, kind="stable")[:max_keypoints])
    return order[chosen]
