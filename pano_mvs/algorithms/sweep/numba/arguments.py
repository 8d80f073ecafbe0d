"""Convert the input of a sweep to the arguments of its kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.combination import source_weights
from pano_mvs.algorithms.sweep.costs.census_gradient import census_weight
from pano_mvs.algorithms.sweep.costs.kernels_constants import CENSUS_GRADIENT
from pano_mvs.algorithms.sweep.numba.kernels_records import Combination, Sources, Sweep, Windows
from pano_mvs.algorithms.sweep.numba.kernels_winner import STATES
from pano_mvs.algorithms.sweep.numba.packing import pack_sources, pack_votes
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.windows import column_offsets
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pad_panorama

BAND_ROWS = 32
"""The rows that `sweep_band` is given at a time."""

NO_VOLUME = np.empty((0, 0, 0), np.uint8)
"""Passed to `sweep_band` where the winners are wanted and the costs are not."""


def sweep_arguments(work: SweepInput) -> Sweep:
    """Return what all bands of a sweep share, as the kernels read it.

    Raises:
        UsageError: if the cost has no compiled version.
    """
    height, width, _ = work.reference.shape
    settings = work.settings
    windows = _windows(work)
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    kernel = settings.matching_cost.kernel
    if kernel is None:
        raise UsageError(f"the sweep cost {settings.cost!r} has no compiled version: use the backend numpy or opencv")
    return Sweep(
        reference=np.stack([pad_panorama(plane, windows.pad) for plane in np.moveaxis(work.reference, -1, 0)]),
        sin_cos_azimuth=np.stack([np.sin(azimuth), np.cos(azimuth)]).astype(np.float32),
        sources=_sources(work),
        windows=windows,
        cost=kernel,
        census_weight=census_weight(settings.compare_radius) if kernel == CENSUS_GRADIENT else 0,
        combination=Combination(
            weights=source_weights((height, width), work.source_from_reference, settings),
            share=settings.weight_share,
            max_count=settings.max_sources(len(work.sources)),
            neutral=np.float32(settings.neutral_cost),
        ),
        scale=np.float32(settings.cost_scale),
    )


def _sources(work: SweepInput) -> Sources:
    packed, colors, starts = pack_sources(work.sources, vector=HAS_VECTOR)
    valid, valid_starts, masked = pack_votes(work)
    return Sources(
        poses=np.stack([np.column_stack([pose.rotation, pose.translation]) for pose in work.source_from_reference]),
        packed=packed,
        colors=colors,
        starts=starts,
        shapes=np.array([source.shape[:2] for source in work.sources]),
        valid=valid,
        valid_starts=valid_starts,
        masked=masked,
        vector=HAS_VECTOR,
    )


def _windows(work: SweepInput) -> Windows:
    size_hw, settings = (work.reference.shape[0], work.reference.shape[1]), work.settings
    compare_radius, box_radius = settings.compare_radius, settings.box_radius
    offsets = column_offsets(size_hw, compare_radius, spherical=settings.spherical_window)
    reach = column_offsets(size_hw, box_radius, spherical=settings.spherical_window)[:, -1].copy()
    pad = max(int(offsets.max()), int(reach.max()) + 1, compare_radius + box_radius)
    return Windows(offsets, reach, compare_radius, box_radius, pad)


def fresh_state(rows: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the state and the planes of `sweep_band` before the first plane: (STATES, rows, W) and (rows, W)."""
    return np.full((STATES, rows, width), np.inf, np.float32), np.zeros((rows, width), np.int32)
