"""What a setting scores on one place: the figures that a search compares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

Ranges = NDArray[np.float32]
FloatArray = NDArray[np.float64]

# Largest ratio of a range that counts as right to the true one, in a map and on a surface.
_RIGHT, _PRECISE = 1.05, 1.01
# The precision at which the share of kept pixels is measured.
PRECISION = 0.95


@dataclass(frozen=True)
class PlaceScores:
    """Means over the references of a place, in percent of the solid angle with a true surface.

    Attributes:
        delta: pixels of the last range map within 5 % of the truth.
        kept: pixels that remain when, of the checked map's pixels in the order of their confidence, as many are kept
            as have a precision of 95 % (within 5 % of the truth).
        surface_f: F-score of the confirmed pixels within 1 % of the truth: harmonic mean of their precision and their
            completeness. A substitute for the F-score of the cloud that needs no fusion.
        confirmed: confirmed pixels.
        confirmed_delta: of the confirmed pixels (not of all pixels), those within 5 % of the truth.
        cpu_s: CPU seconds; of stages whose results were stored, none.
    """

    delta: float
    kept: float
    surface_f: float
    confirmed: float
    confirmed_delta: float
    cpu_s: float = 0.0

    @property
    def score(self) -> float:
        """The figure that a search maximizes."""
        return (self.delta + self.kept + self.surface_f) / 3


def score_place(
    checked: Sequence[RangeMap], last: Sequence[RangeMap], truth: Sequence[Ranges], *, cpu_s: float = 0.0
) -> PlaceScores:
    """Return the scores of a place.

    A range where the truth has none, such as in the sky, counts as wrong.

    Args:
        checked: of each reference, the map that the consistency check returned.
        last: of each reference, the map that the last stage returned.
        truth: of each reference, the true ranges (H, W), NaN where there is no surface.
        cpu_s: CPU seconds that the maps took.
    """
    rows = [_figures(*maps) for maps in zip(checked, last, truth, strict=True)]
    delta, kept, surface_f, confirmed, confirmed_delta = (100 * np.mean(rows, axis=0)).tolist()
    return PlaceScores(delta, kept, surface_f, confirmed, confirmed_delta, cpu_s)


def _figures(checked: RangeMap, last: RangeMap, truth: Ranges) -> tuple[float, ...]:
    weight = np.broadcast_to(pixel_solid_angle(truth.shape)[:, None], truth.shape)
    weight = weight / weight[np.isfinite(truth)].sum()
    right = _within(checked.range, truth, _RIGHT)
    sure = checked.confidence >= CONSISTENT_CONFIDENCE[0]
    confirmed = float(weight[sure].sum())
    return (
        float(weight[_within(last.range, truth, _RIGHT)].sum()),
        kept_at_precision(checked.confidence[checked.valid], right[checked.valid], weight[checked.valid]),
        _f_score(float(weight[sure & _within(checked.range, truth, _PRECISE)].sum()), confirmed),
        confirmed,
        float(weight[sure & right].sum()) / confirmed if confirmed else 0.0,
    )


def kept_at_precision(
    confidence: NDArray[np.uint8], right: NDArray[np.bool_], weight: FloatArray, *, precision: float = PRECISION
) -> float:
    """Return the largest weight of the most confident pixels of which a share of `precision` is right.

    Args:
        confidence: (N,) of the pixels that have a range.
        right: (N,) whether the range is right.
        weight: (N,) of each pixel.
        precision: the share of kept weight that must be right.

    Returns:
        Weight of the pixels kept. Of pixels with equal confidence, a part may be kept, as if they were drawn at random.
    """
    levels, level = np.unique(255 - confidence, return_inverse=True)
    kept = np.concatenate([[0.0], np.cumsum(np.bincount(level, weight, len(levels)))])
    # How much more is right than the precision requires; kept pixels must not fall below 0.
    surplus = np.concatenate([[0.0], np.cumsum(np.bincount(level, weight * (right - precision), len(levels)))])
    enough = int(np.flatnonzero(surplus >= 0)[-1])
    if enough == len(levels):
        return float(kept[-1])
    share = surplus[enough] / (surplus[enough] - surplus[enough + 1])
    return float(kept[enough] + share * (kept[enough + 1] - kept[enough]))


def _within(ranges: Ranges, truth: Ranges, ratio: float) -> NDArray[np.bool_]:
    """Return where a range and the truth differ by at most a factor; not where either is missing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        larger = np.maximum(ranges / truth, truth / ranges)
    return np.asarray(larger < ratio)


def _f_score(right: float, all_found: float) -> float:
    """Return the F-score of a weight that is right among all that was found; all that exists has weight 1."""
    return 2 * right / (all_found + 1) if right else 0.0
