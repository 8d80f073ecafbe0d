"""Thresholds between good, fair and bad figures of a run, for the verdict and the findings of the report."""

from __future__ import annotations

GOOD_REGISTERED, FAIR_REGISTERED = 0.95, 0.5
# Residuals are measured in pixels of the panorama: a median within one pixel is good.
GOOD_RESIDUAL_PX, FAIR_RESIDUAL_PX = 1.0, 2.0
# The sky fills up to half of the sphere, so only a much smaller share of valid pixels is bad.
GOOD_COMPLETE, FAIR_COMPLETE = 0.8, 0.35
# No other view confirms walls without texture: a third of the pixels of a furnished room is a good share.
GOOD_CONSISTENT, FAIR_CONSISTENT = 0.3, 0.12
# A ceiling or floor of which other views confirm less than this is reported, because its ranges may be far off.
FAIR_CONFIRMED_SIDE = 0.15
# A model is bad if more than half of its cameras are doubtful.
FAIR_UNDOUBTED = 0.5


def mood_of(value: float, good: float, fair: float) -> str:
    """Return "good", "fair" or "bad".

    Args:
        value: the figure to judge.
        good: threshold of "good"; a lower bound if it is greater than `fair`, else an upper bound.
        fair: threshold of "fair".
    """
    if good > fair:
        return "good" if value >= good else "fair" if value >= fair else "bad"
    return "good" if value <= good else "fair" if value <= fair else "bad"
