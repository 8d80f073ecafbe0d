"""Combine the costs of the sources at each pixel: all, the best ones, or weighted by parallax."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.geometry import Rigid3, ray_grid

# Of all weight this share is dealt out equally where no source sees range, so that something is compared at all.
_EQUAL_SHARE = 1e-3


def source_weights(
    size_hw: tuple[int, int], source_from_reference: Sequence[Rigid3], settings: SweepSettings
) -> NDArray[np.float32]:
    """Return the weight of every source at every pixel, (S, H, W), with a sum of 1; (0, 0, 0) if all are equal."""
    if settings.combination != "parallax_weighted":
        return np.zeros((0, 0, 0), np.float32)
    return parallax_weights(size_hw, source_from_reference)


def parallax_weights(size_hw: tuple[int, int], source_from_reference: Sequence[Rigid3]) -> NDArray[np.float32]:
    """Return weights in proportion to the parallax by which a source would notice a change of range, (S, H, W).

    A point at range r along the ray f is seen from a source at C, in the reference's frame, under a direction that
    turns by |f × C| for a unit of 1/r, r ≫ |C|: by the baseline times the sine of the angle between ray and baseline.
    It vanishes at the epipoles, where the source sees the point in the same place at any range.

    Args:
        size_hw: of the reference.
        source_from_reference: pose of each source.
    """
    rays = ray_grid(size_hw)
    parallax = np.stack([np.linalg.norm(np.cross(rays, pose.center), axis=-1) for pose in source_from_reference])
    parallax += _EQUAL_SHARE * max(float(np.linalg.norm(pose.center)) for pose in source_from_reference) + 1e-12
    return np.asarray(parallax / parallax.sum(axis=0), dtype=np.float32)
