"""The sweep by OpenCV: whole images warped by cv2.remap, one plane at a time.

cv2.remap rounds positions to 1/32 pixel. Costs are those of the numpy backend. Semi-global matching is the numba
backend's, since OpenCV has it for flat pairs alone.
Memory beyond the pictures and the result: about 40 bytes a pixel and source, and for "sgm" 3 bytes for each pixel and
plane.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.numpy_backend import combine_costs, pixel_cost
from pano_mvs.algorithms.sweep.edge_support import average_volume
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.windows import CostWindow, box_mean
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pad_panorama, ray_grid


class RunningWinner:
    """The cheapest plane so far of every pixel of a picture, and the costs around it."""

    def __init__(self, size_hw: tuple[int, int]) -> None:
        self.count = 0
        self.plane = np.full(size_hw, -2, np.int32)
        self.best, self.before, self.after, self.rival, self.last, self.last_but_one, self.earlier = (
            np.full(size_hw, np.inf, np.float32) for _ in range(7)
        )

    def add(self, cost: NDArray[np.float32]) -> None:
        """Take in the costs (H, W) of the next plane."""
        # The least of all planes but the last: the rivals of this one, should it win.
        earlier = np.minimum(self.earlier, self.last_but_one)
        wins = cost < self.best
        gap = self.count - self.plane
        self.rival = np.where(wins, earlier, np.where(gap > 1, np.minimum(self.rival, cost), self.rival))
        self.after = np.where(wins | (gap == 1), cost, self.after)
        self.before = np.where(wins, self.last, self.before)
        self.best = np.where(wins, cost, self.best)
        self.plane = np.where(wins, np.int32(self.count), self.plane)
        self.earlier, self.last_but_one, self.last = earlier, self.last, cost
        self.count += 1

    def result(self) -> Winners:
        """Return the winners of all planes taken in."""
        before = np.where(self.plane == 0, self.best, self.before)
        return Winners(self.plane, self.best, before, self.after, self.rival)


# cv2.remap holds positions in 16 bits.
_MAX_COLUMNS = 32_000


def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it; equals the numpy backend's except for rounding.

    Raises:
        UsageError: if a picture has more columns than cv2.remap can address.
    """
    widest = max(picture.shape[1] for picture in (work.reference, *work.sources))
    if widest > _MAX_COLUMNS:
        raise UsageError(f"the sweep backend 'opencv' takes at most {_MAX_COLUMNS} columns, got {widest}: use numba")
    settings = work.settings
    size_hw = work.reference.shape[0], work.reference.shape[1]
    lookups = [_Lookup(work, idx, size_hw) for idx in range(len(work.sources))]
    with_volume = settings.aggregation == "sgm"
    volume = np.empty((size_hw[0], len(work.ranges) if with_volume else 0, size_hw[1]), np.uint8)
    winner = RunningWinner(size_hw)
    for plane, virtual_range in enumerate(work.ranges):
        costs = np.stack([_costs_of(work, lookup, virtual_range) for lookup in lookups])
        combined = combine_costs(costs, work).astype(np.float32)
        if with_volume:
            volume[:, plane] = np.minimum(combined * np.float32(settings.cost_scale) + np.float32(0.5), 255)
        else:
            winner.add(combined)
    if not with_volume:
        return winner.result()
    from pano_mvs.algorithms.sweep.backends.numba_backend import (
        winners_by_paths,  # on use: numba is slow to import
    )

    average_volume(volume, work)
    return winners_by_paths(work, volume)


class _Lookup:
    """One source, looked up where the reference's rays end."""

    def __init__(self, work: SweepInput, idx: int, size_hw: tuple[int, int]) -> None:
        pose: Rigid3 = work.source_from_reference[idx]
        self.padded = pad_panorama(work.sources[idx], 1)
        self.valid = None
        if work.source_valid is not None:
            self.valid = pad_panorama(work.source_valid[idx].astype(np.uint8) * 255, 1)
        self.directions = np.moveaxis(ray_grid(size_hw) @ pose.rotation.T, -1, 0).astype(np.float32)
        self.translation = pose.translation

    def at(self, virtual_range: float) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
        """Return the source as the reference would see it at one range, (H, W, C), and where it is valid."""
        x, y, z = (
            axis + np.float32(step)
            for axis, step in zip(self.directions, self.translation / virtual_range, strict=True)
        )
        height, width = self.padded.shape[0] - 2, self.padded.shape[1] - 2
        # cv2 counts from pixel centres: ½ less than we do, and one more for the margin.
        columns = np.arctan2(x, z) * np.float32(width / (2 * np.pi)) + np.float32(width / 2 + 0.5)
        rows = np.arctan2(y, np.hypot(x, z)) * np.float32(height / np.pi) + np.float32(height / 2 + 0.5)
        warped = cv2.remap(self.padded, columns, rows, cv2.INTER_LINEAR)
        warped = np.asarray(warped, dtype=np.uint8).reshape(*columns.shape, -1)
        if self.valid is None:
            return warped, None
        return warped, np.asarray(cv2.remap(self.valid, columns, rows, cv2.INTER_LINEAR)) == 255


def _costs_of(work: SweepInput, lookup: _Lookup, virtual_range: float) -> NDArray[np.float64]:
    """Return the costs of one plane in one source, (H, W), infinite where it is not valid."""
    settings = work.settings
    warped, votes = lookup.at(virtual_range)
    result = pixel_cost(work.reference, warped.astype(np.float64), settings)
    if not settings.matching_cost.averages_itself:
        size_hw = work.reference.shape[0], work.reference.shape[1]
        result = box_mean(result, CostWindow.of(size_hw, settings.box_radius, spherical=settings.spherical_window))
    return result if votes is None else np.where(votes, result, np.inf)
