"""Convert winning planes to ranges with confidence, for all backends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.scene.range_map import WEAK_CONFIDENCE, RangeMap

_ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Winners:
    """The cheapest plane of every pixel, and the costs around it.

    Attributes:
        plane: (H, W) int32 index of the cheapest plane, the nearest one of equals.
        cost: (H, W) float32 its cost.
        before: (H, W) float32 the cost of the plane before it; of the plane itself where it is the first.
        after: (H, W) float32 the cost of the plane after it; of the plane itself where it is the last.
        rival: (H, W) float32 the least cost of all planes that are not next to it; infinite if there is none.
        lean: (H, W) float32 how many planes beyond `plane` the winner really lies; None: everywhere 0.
    """

    plane: NDArray[np.int32]
    cost: NDArray[np.float32]
    before: NDArray[np.float32]
    after: NDArray[np.float32]
    rival: NDArray[np.float32]
    lean: NDArray[np.float32] | None = None

    @staticmethod
    def unset(size_hw: tuple[int, int]) -> Winners:
        """Return winners of a picture that are yet to be written."""
        costs = [np.empty(size_hw, np.float32) for _ in range(4)]
        return Winners(np.empty(size_hw, np.int32), *costs)

    @property
    def position(self) -> NDArray[np.float64]:
        """Where the winner lies among the planes, (H, W)."""
        plane = self.plane.astype(np.float64)
        return plane if self.lean is None else plane + self.lean

    def put(self, rows: slice, some: Winners) -> None:
        """Write those of some rows."""
        for name in ("plane", "cost", "before", "after", "rival"):
            getattr(self, name)[rows] = getattr(some, name)

    def of_rows(self, rows: slice) -> Winners:
        """Return those of some rows, as views."""
        lean = None if self.lean is None else self.lean[rows]
        return Winners(self.plane[rows], self.cost[rows], self.before[rows], self.after[rows], self.rival[rows], lean)


def range_map_from_winners(
    winners: Winners,
    *,
    range_at: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    settings: SweepSettings,
    seen: NDArray[np.bool_],
) -> RangeMap:
    """Return the range and the confidence of every pixel, NaN and 0 where it was not seen.

    `winners`: of all pixels. `range_at`: returns the ranges at positions between the planes, see `SweepInput.range_at`.
    `settings`: planes, selection and confidence. `seen`: (H, W) where the reference is valid and at least one source
    saw the winner.
    """
    result, sure = np.empty(seen.shape, np.float32), np.empty(seen.shape, np.uint8)
    for first in range(0, len(seen), _ROWS_AT_ONCE):  # in 64 bits, whole pictures would take gigabytes at 8192×4096
        rows = slice(first, first + _ROWS_AT_ONCE)
        some = winners.of_rows(rows)
        position = some.position
        if settings.selection != "winner":
            position += subplane_offset(some, planes=settings.planes, shape=settings.selection)
        result[rows] = np.where(seen[rows], range_at(position), np.nan)
        sure[rows] = np.where(seen[rows], confidence(some, measure=settings.confidence), 0)
    return RangeMap(result, sure)


def subplane_offset(winners: Winners, *, planes: int, shape: Literal["parabola", "vfit"]) -> NDArray[np.float64]:
    """Return where between −½ and ½ plane the minimum of a curve through three costs is, (H, W); 0 at the ends.

    With the steps a and b from the winner's cost up to that before and after it, the parabola has its minimum at
    ½ (a − b)/(a + b), and two lines of opposite slopes meet at ½ (a − b)/max(a, b).
    """
    before, after = winners.before.astype(np.float64), winners.after.astype(np.float64)
    steps = before - winners.cost, after - winners.cost
    scale = steps[0] + steps[1] if shape == "parabola" else np.maximum(*steps)
    inner = (winners.plane > 0) & (winners.plane < planes - 1) & (scale > 0)
    offset = 0.5 * (before - after) / np.where(inner, scale, 1.0)
    return np.where(inner, np.clip(offset, -0.5, 0.5), 0.0)


def confidence(winners: Winners, *, measure: Literal["peak_ratio", "curvature", "combined"]) -> NDArray[np.uint8]:
    """Return how sure the winner is, (H, W) uint8 in 64–127.

    "peak_ratio" is the uniqueness 1 − cost/rival: how much dearer the best rival is. It vanishes on bare surfaces,
    along the baseline (where all ranges look the same to every source) and between two equally good ranges.
    "curvature" is 1 − 2 cost/(before + after): how sharp the minimum is. "combined" is their geometric mean.
    """
    shares = []
    if measure != "curvature":
        no_rival = np.isinf(winners.rival)  # three planes or fewer
        rival = np.where(no_rival, 1.0, winners.rival).astype(np.float64)
        cost = np.where(no_rival, 0.0, winners.cost)
        # A winner cheaper than its best rival by this share of the rival's cost is as sure as can be.
        shares.append((rival - cost) / np.maximum(rival, 1e-6) / 0.8)
    if measure != "peak_ratio":
        around = winners.before.astype(np.float64) + winners.after
        # Likewise one that is cheaper than the planes next to it.
        shares.append((around - 2.0 * winners.cost) / np.maximum(around, 1e-6) / 0.5)
    low, high = WEAK_CONFIDENCE
    share = np.prod(np.clip(shares, 0, 1), axis=0) ** (1 / len(shares))
    return np.asarray(np.rint(low + share * (high - low)), dtype=np.uint8)
