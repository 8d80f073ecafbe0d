"""Key points of panoramas whose position is known, with which those of photographs are matched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, pixel_from_ray
from pano_mvs.scene import Features, RangeMap

_BESIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))


@dataclass(frozen=True, slots=True, eq=False)
class KnownPoints:
    """The key points of a panorama whose position is known."""

    descriptors: NDArray[np.generic]  # (N, D)
    points_in_world: NDArray[np.float64]  # (N, 3) float64
    keypoints_idx: NDArray[np.intp]  # (N,) their positions among all key points of the panorama


def has_sift(features: Features) -> bool:
    """Return whether key points can be compared with those of photographs."""
    return features.metric == "l2" and features.descriptors.shape[1] == 128


def known_points(
    features: Features, cam_from_world: Rigid3, range_map: RangeMap, *, min_confidence: int
) -> KnownPoints:
    """Return the key points of a panorama that its range map places in the world.

    Key points at edges of surfaces, whose range is uncertain, are left out.

    Args:
        features: key points by `extract_sift`.
        cam_from_world: the panorama's pose.
        range_map: its ranges.
        min_confidence: smallest confidence of a range that is used.
    """
    height, width = range_map.range.shape
    x, y = np.floor(pixel_from_ray(features.bearings, (height, width))).astype(np.intp).T
    x, y = x % width, np.clip(y, 0, height - 1)
    ranges = range_map.range[y, x].astype(np.float64)
    beside = np.stack([range_map.range[np.clip(y + dy, 0, height - 1), (x + dx) % width] for dx, dy in _BESIDE])
    with np.errstate(invalid="ignore"):
        # Ranges are used where the surface is continuous: the relative difference to the pixels beside it.
        smooth = (np.abs(beside - ranges) <= 0.03 * ranges).all(axis=0)
    keep = smooth & np.isfinite(ranges) & (range_map.confidence[y, x] >= min_confidence)
    points = cam_from_world.inverse().apply(features.bearings[keep] * ranges[keep, None])
    return KnownPoints(features.descriptors[keep], points, np.flatnonzero(keep))
