"""Winner takes all, one plane at a time, without a cost volume."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.winner import Winners


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
