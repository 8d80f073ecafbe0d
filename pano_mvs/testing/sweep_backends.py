"""Contract of sweep backends: with any settings, they find the winners of the numpy backend."""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.hypotheses import mean_baseline_of, virtual_ranges
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render

NEAR, FAR = 0.5, 6.0
_SIZES_HW = [(16, 32), (18, 36), (25, 50), (32, 64), (20, 30), (40, 24)]
_COSTS = ("census", "zncc", "sad", "sad_gradient", "census_gradient")
_COMBINATIONS = ("sum", "best_half", "best_k", "parallax_weighted")
_COMBINED = list(itertools.product(_COSTS, _COMBINATIONS, ("box", "sgm")))
CASES = len(_COMBINED)
"""Number of cases: every cost with every combination and aggregation, other settings drawn at random."""


@dataclass(frozen=True, eq=False)
class SweepCase:
    """Input of a sweep: small views of a synthetic room, of different sizes, with or without masks."""

    pictures: tuple[NDArray[np.uint8], ...]
    source_from_reference: tuple[Rigid3, ...]
    masks: tuple[NDArray[np.bool_], ...]
    settings: SweepSettings

    @property
    def ranges(self) -> NDArray[np.float64]:
        """The depth hypotheses, (D,)."""
        return virtual_ranges(
            NEAR,
            FAR,
            planes=self.settings.planes,
            spacing=self.settings.spacing,
            baseline=mean_baseline_of(self.source_from_reference),
        )

    def swept(self, backend: str, *, device: str = "auto") -> RangeMap:
        """Return the range map that a backend computes."""
        return sweep_range(
            self.pictures[0],
            self.pictures[1:],
            self.source_from_reference,
            near=NEAR,
            far=FAR,
            settings=self.settings,
            backend=backend,
            device=device,
            reference_mask=self.masks[0],
            source_masks=self.masks[1:],
        )


def cost_of_case(number: int) -> str:
    """Return the cost of a case, without rendering its images."""
    return _COMBINED[number][0]


@functools.cache
def sweep_case(number: int) -> SweepCase:
    """Return one of the `CASES`; the same for every call."""
    rng = np.random.default_rng([2026, number])
    cost, combination, aggregation = _COMBINED[number]
    settings = SweepSettings(planes=int(rng.integers(3, 24))).replace(
        spacing=str(rng.choice(["parallax", "inverse", "log", "uniform"])),
        cost=cost,
        window=int(rng.choice([3, 5, 7])),
        spherical_window=bool(rng.integers(2)),
        combination=combination,
        best=int(rng.integers(1, 4)),
        aggregation=aggregation,
        support=int(rng.choice([1, 3, 5])),
        p2_contrast=float(rng.choice([0.0, 15.0])),
        p2_falloff=("inverse", "square")[number // 2 % 2],
        edge_support=(1, 3, 5)[number // 2 % 3],
        edges=("colors", "grey")[number % 4 == 3],
        derotate=bool(rng.integers(4) == 0),
        exposure=bool(rng.integers(4) == 0),
    )
    count = int(rng.integers(2, 6))
    poses = capture_poses(count, seed=number, spread=0.4)
    sizes = [_SIZES_HW[idx] for idx in rng.integers(0, len(_SIZES_HW), count)]
    room = default_room(number % 3)
    pictures = tuple(render(room, pose, size)[0] for pose, size in zip(poses, sizes, strict=True))
    masks = tuple(np.ones(size, np.bool_) for size in sizes)
    for mask in masks if rng.integers(2) else ():
        mask[-mask.shape[0] // 5 :] = False
        mask[4:9, 3:11] = False
    return SweepCase(pictures, tuple(pose @ poses[0].inverse() for pose in poses[1:]), masks, settings)


@functools.cache
def _by_numpy(number: int) -> RangeMap:
    return sweep_case(number).swept("numpy")


def agreement(number: int, backend: str, *, device: str = "auto") -> float:
    """Return the share of pixels of a case for which a backend is within half a level of the numpy backend.

    Pixels without a range in both agree, too. The contract requires a mean of 0.99 over all cases: a different order of
    summation, or different rounding of positions, changes the winners of some pixels on bare walls.
    """
    found = sweep_case(number).swept(backend, device=device)
    found.check()
    return share_alike(found, _by_numpy(number), sweep_case(number).ranges)


def share_alike(one: RangeMap, other: RangeMap, ranges: NDArray[np.float64]) -> float:
    """Return the share of pixels within half a level of each other, or without a range in both."""
    with np.errstate(invalid="ignore"):
        close = np.abs(plane_position(one.range, ranges) - plane_position(other.range, ranges)) < 0.5
    return float((close | (np.isnan(one.range) & np.isnan(other.range))).mean())


def plane_position(found: NDArray[np.float32], ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the positions of ranges between the depth hypotheses, (D,), of any shape; 1/range is interpolated."""
    return np.interp(-1 / found.astype(np.float64), -1 / ranges, np.arange(len(ranges)))
