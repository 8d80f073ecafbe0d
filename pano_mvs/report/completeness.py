"""How much of the sphere around a view is consistent, weak, filled, invalid or masked, by solid angle."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, WEAK_CONFIDENCE

_ROWS = 256


@dataclass(frozen=True)
class Shares:
    """Shares of the sphere, which sum to 1.

    Attributes:
        consistent: other views agree (confidence 128–255).
        weak: seen, but not confirmed (64–127).
        filled: interpolated, not seen (1–63).
        invalid: no range.
        masked: excluded by a mask, or sky.
    """

    consistent: float
    weak: float
    filled: float
    invalid: float
    masked: float

    @property
    def complete(self) -> float:
        """The share of the unmasked sphere that has a range; 0 if all is masked."""
        return min(1.0, (self.consistent + self.weak + self.filled) / max(1e-9, 1 - self.masked))

    @property
    def confirmed(self) -> float:
        """The share of the unmasked sphere on which other views agree."""
        return min(1.0, self.consistent / max(1e-9, 1 - self.masked))


def shares_of(confidence: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Shares:
    """Return the shares of a view by the solid angle of its pixels, sampling every n-th row and column of large maps.

    Args:
        confidence: (H, W) uint8 as of range maps.
        mask: (H, W) bool, False is masked or sky; None if neither is known.
    """
    step = max(1, confidence.shape[0] // _ROWS)
    sampled = np.asarray(confidence[step // 2 :: step, step // 2 :: step])
    height, width = sampled.shape
    elevation_rad = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    weights = np.repeat(np.cos(elevation_rad)[:, None], width, axis=1)
    weights /= weights.sum()
    kept = np.ones(sampled.shape, bool) if mask is None else mask[step // 2 :: step, step // 2 :: step]
    classes = np.digitize(sampled, [FILLED_CONFIDENCE[0], WEAK_CONFIDENCE[0], CONSISTENT_CONFIDENCE[0]])
    classes[(classes == 0) & ~kept] = 4
    invalid, filled, weak, consistent, masked = np.bincount(classes.ravel(), weights.ravel(), minlength=5)
    return Shares(*(round(float(share), 6) for share in (consistent, weak, filled, invalid, masked)))


def shares_from_fact(fact: Any) -> Shares | None:
    """Return shares from the JSON value of `fact_of`; None for other values."""
    valid = isinstance(fact, list) and len(fact) == 5 and all(isinstance(value, int | float) for value in fact)
    return Shares(*map(float, fact)) if valid else None


def fact_of(shares: Shares) -> list[float]:
    """Return shares as a JSON value."""
    return list(astuple(shares))
