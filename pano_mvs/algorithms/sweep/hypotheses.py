"""The depth hypotheses of a sweep: the ranges that it tests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.errors import UsageError

Spacing = Literal["inverse", "log", "uniform"]

# Nothing is nearer than this share of the longest baseline …
_NEAREST_BASELINES = 0.3
# … and a point this much parallax away from infinity looks the same as one at infinity.
_MIN_PARALLAX_PX = 0.5


def virtual_ranges(near: float, far: float, *, planes: int, spacing: Spacing) -> NDArray[np.float64]:
    """Return the depth hypotheses from near to far, (D,), ascending, in the unit of near and far."""
    return range_at(np.arange(planes), near, far, planes=planes, spacing=spacing)


def range_at(positions: ArrayLike, near: float, far: float, *, planes: int, spacing: Spacing) -> NDArray[np.float64]:
    """Return the range at positions between the planes (0 is near, planes − 1 is far); any shape.

    With s = position / (planes − 1): 1/range = (1 − s)/near + s/far for "inverse", the same in log range or in range
    for the others.

    Raises:
        UsageError: unless 0 < near < far, both finite.
    """
    if not (0 < near < far and np.isfinite(far)):
        raise UsageError(f"depth hypotheses need 0 < near < far, got near {near} and far {far}")
    share = np.asarray(positions, dtype=np.float64) / (planes - 1)
    result: NDArray[np.float64]
    if spacing == "inverse":
        result = 1 / ((1 - share) / near + share / far)
    elif spacing == "log":
        result = near * (far / near) ** share
    else:
        result = near + (far - near) * share
    return result


def range_limits(baselines: Sequence[float], *, width: int) -> tuple[float, float]:
    """Return the limits of what a sweep can see, from the cameras alone.

    Args:
        baselines: distances from the reference to its sources, in scene units; at least one positive.
        width: columns of the reference picture: one pixel at the equator is 2π/width.

    Returns:
        (near, far): 0.3 of the longest baseline b, and the range b / (½ px) at which parallax falls under half a
        pixel; the images do not constrain ranges beyond it.

    Raises:
        UsageError: if no baseline is positive.
    """
    longest = max(baselines, default=0.0)
    if not (longest > 0 and np.isfinite(longest)):
        raise UsageError("a sweep needs a source at some distance from the reference: all baselines are zero")
    return _NEAREST_BASELINES * longest, longest / (_MIN_PARALLAX_PX * 2 * np.pi / width)
