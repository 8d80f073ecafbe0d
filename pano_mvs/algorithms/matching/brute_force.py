"""Brute-force matching of descriptors: nearest neighbour, ratio test, mutual check."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.nearest_two import MAX_RATIO, Comparable
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features


@checks_settings
def match_features(
    first: Features,
    second: Features,
    *,
    ratio: Annotated[float, Setting("maximum ratio of best to second-best distance", gt=0, le=1)] = MAX_RATIO,
    mutual: Annotated[bool, Setting("keep only matches that are each other's best")] = True,
) -> NDArray[np.int32]:
    """Match the key points of two images by their descriptors.

    A match is kept if its distance is below `ratio` times that of the second nearest (Lowe 2004, section 7.1).

    Args:
        first: key points of the first image.
        second: key points of the second image, with descriptors of the same kind.
        ratio: in (0, 1]; 1 keeps every nearest neighbour.

    Returns:
        (M, 2) int32 positions in the first and second image, by ascending position in the first.

    Raises:
        UsageError: if the descriptors are of different kinds, or the ratio is out of range.
    """
    if first.metric != second.metric or first.descriptors.shape[1] != second.descriptors.shape[1]:
        raise UsageError(
            f"descriptors of different kinds cannot be compared: {first.metric} with {first.descriptors.shape[1]} and "
            f"{second.metric} with {second.descriptors.shape[1]} components. Use the same feature stage for all images"
        )
    if len(first) == 0 or len(second) < 2:
        return np.zeros((0, 2), np.int32)
    match_descriptors = match_l2 if first.metric == "l2" else _match_hamming
    return match_descriptors(first.descriptors, second.descriptors, ratio=ratio, mutual=mutual)


def match_l2(
    first: NDArray[np.generic], second: NDArray[np.generic], *, ratio: float = MAX_RATIO, mutual: bool = True
) -> NDArray[np.int32]:
    """Match descriptors, (N, D) and (M, D), by Euclidean distance; see `match_features`."""
    found = Comparable(first).nearest_two(Comparable(second))
    kept = found.squared < np.float32(ratio**2) * found.next_squared if ratio < 1 else np.ones(len(first), np.bool_)
    if mutual:
        kept &= found.squared <= found.squared_back[found.nearest]
    return _matches(np.flatnonzero(kept), found.nearest, found.squared, mutual=mutual)


def one_to_one(kept: NDArray[np.intp], nearest: NDArray[np.intp], distance: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return matches (M, 2), only the first of several equally near ones of a second key point.

    Args:
        kept: (K,) positions of the first image's key points that are matched.
        nearest: (N,) their nearest key points in the second image.
        distance: (N,) to these.
    """
    by_distance = kept[np.argsort(distance[kept], kind="stable")]
    _, first_use = np.unique(nearest[by_distance], return_index=True)
    kept = np.sort(by_distance[first_use])
    return np.stack([kept, nearest[kept]], axis=1).astype(np.int32)


def _match_hamming(
    first: NDArray[np.generic], second: NDArray[np.generic], *, ratio: float, mutual: bool
) -> NDArray[np.int32]:
    found = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(first, second, k=2)
    nearest = np.array([near.trainIdx for near, _ in found], np.intp)
    distance = np.array([near.distance for near, _ in found], np.float32)
    next_distance = np.array([far.distance for _, far in found], np.float32)
    kept = distance < ratio * next_distance if ratio < 1 else np.ones(len(first), np.bool_)
    if mutual:
        back = cv2.BFMatcher(cv2.NORM_HAMMING).match(second, first)
        best_of_column = np.array([match.distance for match in back], np.float32)
        kept &= distance <= best_of_column[nearest]
    return _matches(np.flatnonzero(kept), nearest, distance, mutual=mutual)


def _matches(
    kept: NDArray[np.intp], nearest: NDArray[np.intp], distance: NDArray[np.float32], *, mutual: bool
) -> NDArray[np.int32]:
    return one_to_one(kept, nearest, distance) if mutual else np.stack([kept, nearest[kept]], axis=1).astype(np.int32)
