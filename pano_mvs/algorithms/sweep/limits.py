"""Estimate the near and far limits of a sweep from small sweeps of the reference and its sources that must agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.consistency import check_consistency
from pano_mvs.algorithms.filters.smoothing import remove_speckles
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.panoramas import contrast_around, reduced_mask, reduced_panorama
from pano_mvs.algorithms.sweep.backends.registry import helper_backend
from pano_mvs.algorithms.sweep.hypotheses import mean_baseline, range_at, range_limits
from pano_mvs.algorithms.sweep.preparation import is_bare
from pano_mvs.algorithms.sweep.settings import SURFACE_SETTINGS
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pixel_solid_angle
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE

# Rounding the limits outward to steps of a quarter octave keeps the planes, and with them the ranges, the same when
# the pictures change by next to nothing.
_STEPS_PER_OCTAVE = 4
_WIDTH = 256
_PLANES = 96
_SETTINGS = SURFACE_SETTINGS.replace(planes=_PLANES)
_MAX_PICTURES = 5
# The small sweeps begin at this share of the mean baseline.
_NEAREST_BASELINES = 0.05
# A plain surface nearer than any textured one ends in the nearest planes, in an area of at least this share of the
# sphere. The near limit is then lowered in steps of half an octave. Where four do not help, chance decides.
_MIN_ENDED_SHARE = 0.003


def limits_by_sweeping(
    pictures: Sequence[NDArray[np.uint8]],
    cams_from_world: Sequence[Rigid3],
    *,
    masks: Sequence[NDArray[np.bool_]],
    backend: str = "numba",
    device: str = "auto",
) -> tuple[float, float]:
    """Return the nearest and the farthest range worth trying, in scene units.

    The reference and its first four sources are each swept at 256 columns between very wide limits. What two of them
    agree on, where there is texture, gives the limits: its 0.5 % and 99.5 % quantiles by solid angle, with a margin.
    Unlike sparse points this sees smooth and near surfaces too, and it does not care how the pictures are turned.
    Where a tenth of the sphere lies as good as infinitely far (the sky), the farthest range is the resolution's limit.
    If a small sweep between these limits ends in the nearest planes on a large area without texture, the surface there
    may be nearer than all that have texture. The near limit is then lowered until no such area is left.

    `pictures`: the reference, then its sources, (H, W, 3) uint8 RGB each. `cams_from_world`: pose of each. `masks`: (H,
    W) of each, False is ignored. `backend`: of the small sweeps; numba where it does not have their cost. `device`:
    where it computes, if it can choose.

    Returns:
        (near, far); from the baselines and the angular resolution alone where no more than 1 % of what is not masked
        agrees.

    Raises:
        UsageError: if there is no source, or no source at another place.
    """
    if not len(pictures) == len(cams_from_world) == len(masks) or len(pictures) < 2:
        raise UsageError("limits need a reference and at least one source, each with its pose and mask")
    poses = list(cams_from_world[:_MAX_PICTURES])
    width = pictures[0].shape[1]
    small = [reduced_panorama(picture, _WIDTH) for picture in pictures[:_MAX_PICTURES]]
    small_masks = [reduced_mask(mask, _WIDTH) for mask in masks[:_MAX_PICTURES]]
    sweeps = _SmallSweeps(small, small_masks, poses, helper_backend(backend), device)
    nearest, farthest = range_limits(_baselines(0, poses), width=width)
    maps = [_coarse(idx, sweeps, _others(idx, poses), width=width) for idx in range(len(poses))]
    checked = _agreed(0, maps, range(1, len(poses)), sweeps=sweeps)
    agreed = checked.confidence >= CONSISTENT_CONFIDENCE[0]
    solid_angle = np.broadcast_to(pixel_solid_angle(agreed.shape)[:, None], agreed.shape)
    seen_angle = solid_angle[small_masks[0]].sum()
    if solid_angle[agreed].sum() <= 0.01 * seen_angle:
        return nearest, farthest
    near, far = _quantiles(checked.range[agreed], solid_angle[agreed])
    steps = np.log2([min(nearest, 0.7 * near), 1.3 * far]) * _STEPS_PER_OCTAVE
    near, far = (
        float(2 ** (np.floor(steps[0]) / _STEPS_PER_OCTAVE)),
        float(2 ** (np.ceil(steps[1]) / _STEPS_PER_OCTAVE)),
    )
    # Outdoors this share of what is not masked is sky. What ends there, at a third of the farthest measurable range or
    # beyond, sets no quantile, and with planes even in 1/range it costs next to none to go all the way.
    open_angle = solid_angle[maps[0].range > (1 / 3) * farthest].sum()
    far = max(far, farthest) if open_angle > 0.1 * seen_angle else far
    return _lowered(near, far, sweeps), far


@dataclass(frozen=True, eq=False)
class _SmallSweeps:
    """Reduced pictures that can be swept against each other: (H, W, 3) each, with masks (H, W) and poses."""

    pictures: Sequence[NDArray[np.uint8]]
    masks: Sequence[NDArray[np.bool_]]
    poses: Sequence[Rigid3]
    backend: str
    device: str

    def range_map(self, idx: int, others: Sequence[int], *, near: float, far: float) -> RangeMap:
        """Return the range map of one of the pictures, swept against some others."""
        return sweep_range(
            self.pictures[idx],
            [self.pictures[other] for other in others],
            [self.poses[other] @ self.poses[idx].inverse() for other in others],
            near=near,
            far=far,
            settings=_SETTINGS,
            backend=self.backend,
            device=self.device,
            reference_mask=self.masks[idx],
            source_masks=[self.masks[other] for other in others],
        )


def agreed_ranges(
    pictures: Sequence[NDArray[np.uint8]],
    cams_from_world: Sequence[Rigid3],
    sources: Sequence[Sequence[int]],
    *,
    masks: Sequence[NDArray[np.bool_]],
) -> list[RangeMap]:
    """Return range maps of 256 columns for all views, from small sweeps between very wide limits.

    They are consistent (confidence 128 or more) where there is texture and a source agrees, and filled elsewhere.
    `sources`: of each view, the positions of others at other places.
    """
    small = [reduced_panorama(picture, _WIDTH) for picture in pictures]
    sweeps = _SmallSweeps(small, [reduced_mask(mask, _WIDTH) for mask in masks], list(cams_from_world), "numba", "auto")
    maps = [_coarse(idx, sweeps, others, width=pictures[idx].shape[1]) for idx, others in enumerate(sources)]
    return [_agreed(idx, maps, others, sweeps=sweeps) for idx, others in enumerate(sources)]


def _coarse(idx: int, sweeps: _SmallSweeps, others: Sequence[int], *, width: int) -> RangeMap:
    """Return the range map of one of the pictures between very wide limits."""
    baselines = [_baselines(idx, sweeps.poses)[other] for other in others]
    far = range_limits(baselines, width=width)[1]
    return sweeps.range_map(idx, others, near=_NEAREST_BASELINES * mean_baseline(baselines), far=far)


def _agreed(idx: int, maps: Sequence[RangeMap], others: Sequence[int], *, sweeps: _SmallSweeps) -> RangeMap:
    """Return a map that is consistent where there is texture and another one agrees, and filled elsewhere."""
    checked = check_consistency(
        maps[idx],
        sweeps.poses[idx],
        [maps[other] for other in others],
        source_poses=[sweeps.poses[other] for other in others],
        max_relative_error=0.1,
        max_reprojection_px=1.5,
        min_support=0,
        min_motion_px=0,
    )
    agreed = (checked.confidence >= CONSISTENT_CONFIDENCE[0]) & textured_pixels(sweeps.pictures[idx])
    confidence = np.where(agreed, checked.confidence, np.minimum(checked.confidence, np.uint8(FILLED_CONFIDENCE[1])))
    return RangeMap(checked.range, confidence)


def _lowered(near: float, far: float, sweeps: _SmallSweeps) -> float:
    """Return the near limit, lowered until no large area without texture ends there; unchanged if one always does."""
    bare = is_bare(sweeps.pictures[0])
    most_px = _MIN_ENDED_SHARE * 2 / np.pi * bare.size
    baseline = mean_baseline(_baselines(0, sweeps.poses))
    others = _others(0, sweeps.poses)
    for step in range(4 + 1):
        lower = near / 2 ** (step / 2)
        found = sweeps.range_map(0, others, near=lower, far=far)
        first = range_at(3, lower, far, planes=_PLANES, spacing=_SETTINGS.spacing, baseline=baseline)
        ended = np.where(bare & (found.range < first), np.float32(lower), np.float32(np.nan))
        if not remove_speckles(with_ranges(found, ended), max_size_px=most_px).valid.any():
            return float(lower)
    return near


def _others(idx: int, poses: Sequence[Rigid3]) -> list[int]:
    """Return the cameras that are at another place than one of them."""
    return [other for other, baseline in enumerate(_baselines(idx, poses)) if baseline > 0]


def _baselines(idx: int, poses: Sequence[Rigid3]) -> list[float]:
    """Return the distance of each camera from one of them (its own is 0)."""
    return [float(np.linalg.norm(pose.center - poses[idx].center)) for pose in poses]


def textured_pixels(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels, (H, W), in whose surroundings there is something to match."""
    # Grey levels between the darkest and the brightest pixel of a 5×5 window; plain walls agree with each other
    # anywhere.
    return contrast_around(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), 2) >= 4


def _quantiles(ranges: NDArray[np.float32], weights: NDArray[np.float64]) -> tuple[float, float]:
    order = np.argsort(ranges, kind="stable")
    below = np.cumsum(weights[order]) / weights.sum()
    near, far = np.searchsorted(below, [0.005, 0.995])
    return float(ranges[order[near]]), float(ranges[order[min(far, len(order) - 1)]])
