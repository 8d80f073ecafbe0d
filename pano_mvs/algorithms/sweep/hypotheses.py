"""The depth hypotheses of a sweep: the ranges that it tests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3

Spacing = Literal["parallax", "inverse", "log", "uniform"]

# A surface this near, as a share of the mean baseline, is expected anywhere.
_NEAREST_BASELINES = 0.5


def virtual_ranges(
    near: float, far: float, *, planes: int, spacing: Spacing, baseline: float = 0.0
) -> NDArray[np.float64]:
    """Return the depth hypotheses from near to far, (D,), ascending; see `range_at`."""
    return range_at(np.arange(planes), near, far, planes=planes, spacing=spacing, baseline=baseline)


def range_at(
    positions: ArrayLike, near: float, far: float, *, planes: int, spacing: Spacing, baseline: float = 0.0
) -> NDArray[np.float64]:
    """Return the range at positions between the planes (0 is near, planes − 1 is far); any shape.

    With s = position / (planes − 1): 1/range = (1 − s)/near + s/far for "inverse", and the same in log range for "log"
    or in range for "uniform". For "parallax", asinh(baseline/range) is even. That is even in 1/range beyond the
    baseline, where a point moves by the same angle in a source from plane to plane, and even in log range within it,
    where a source sees the point at a right angle or from behind and 1/range would place most planes.

    `positions`: of any shape. `near`: the nearest depth hypothesis. `far`: the farthest one, in the same unit.
    `planes`: number of depth hypotheses. `spacing`: what is even. `baseline`: usual distance of the sources from the
    reference, for "parallax"; 0 is the same as "inverse".

    Raises:
        UsageError: unless 0 < near < far, both finite.
    """
    if not (0 < near < far and np.isfinite(far)):
        raise UsageError(f"depth hypotheses need 0 < near < far, got near {near} and far {far}")
    share = np.asarray(positions, dtype=np.float64) / (planes - 1)
    result: NDArray[np.float64]
    if spacing == "parallax" and baseline > 0:
        angle = (1 - share) * np.arcsinh(baseline / near) + share * np.arcsinh(baseline / far)
        result = baseline / np.sinh(angle)
    elif spacing in ("inverse", "parallax"):
        result = 1 / ((1 - share) / near + share / far)
    elif spacing == "log":
        result = near * (far / near) ** share
    else:
        result = near + (far - near) * share
    return result


def range_limits(baselines: Sequence[float], *, width: int) -> tuple[float, float]:
    """Return the limits of what a sweep can see, from the cameras alone.

    `baselines`: distances from the reference to its sources, in scene units; at least one positive. `width`: columns of
    the reference picture: one pixel at the equator is 2π/width.

    Returns:
        (near, far): half of the mean baseline, and the range b / (½ px), where b is the longest baseline, at which
        parallax falls under half a pixel; the images do not constrain ranges beyond it.

    Raises:
        UsageError: if no baseline is positive.
    """
    longest = max(baselines, default=0.0)
    if not (longest > 0 and np.isfinite(longest)):
        raise UsageError("a sweep needs a source at some distance from the reference: all baselines are zero")
    return _NEAREST_BASELINES * mean_baseline(baselines), longest / (0.5 * 2 * np.pi / width)


def mean_baseline_of(source_from_reference: Sequence[Rigid3]) -> float:
    """Return the mean distance of the sources that are not at the reference's place; 0 if there are none."""
    return mean_baseline([float(np.linalg.norm(pose.translation)) for pose in source_from_reference])


def mean_baseline(baselines: Sequence[float]) -> float:
    """Return the mean of the positive baselines; 0 if there are none."""
    positive = [baseline for baseline in baselines if baseline > 0]
    return float(np.mean(positive)) if positive else 0.0
