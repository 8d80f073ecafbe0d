"""The exposure of each panorama relative to the others, from the points of a surface that several see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_ROUNDS = 30
# Darker or brighter values are clipped or noisy.
_DARKEST, _BRIGHTEST = 8.0, 247.0
# A gain from few points is uncertain: as if this many further points had seen no difference.
_PRIOR_POINTS = 30.0
# Differences of the logarithm beyond this are moved things, reflections or wrong ranges.
_MAX_RESIDUAL = 0.15
_GAIN_LIMITS = 0.4, 2.5


def view_gains(colors: NDArray[np.float32], weights: NDArray[np.float32]) -> FloatArray:
    """Return the factor of each channel that makes panoramas equally bright, (V, 3).

    The logarithm of a point's colour is modelled as that of the surface plus that of the panorama's exposure; both are
    found alternately, with weights 1 / (1 + (residual / 0.15)²) against moved things and reflections. The mean of the
    logarithms is 0.

    Args:
        colors: (V, P, 3) colours of points as each panorama sees them, 0 to 255.
        weights: (V, P) weights, 0 where a panorama does not see the point.
    """
    usable = (weights > 0) & (colors.min(axis=-1) > _DARKEST) & (colors.max(axis=-1) < _BRIGHTEST)
    usable &= usable.sum(axis=0) > 1
    gains = np.ones((len(colors), 3))
    shared = usable.any(axis=0)
    if not shared.any():
        return gains
    seen = usable[:, shared]
    for channel in range(3):
        logs = np.log(np.maximum(colors[:, shared, channel].astype(np.float64), 1.0))
        gains[:, channel] = np.exp(-_log_exposures(logs, seen))
    return np.clip(gains, *_GAIN_LIMITS)


def _log_exposures(logs: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
    exposure = np.zeros(len(logs))
    robust = seen.astype(np.float64)
    for _ in range(_ROUNDS):
        surface = ((logs - exposure[:, None]) * robust).sum(axis=0) / robust.sum(axis=0)
        differences = logs - surface
        exposure = (differences * robust).sum(axis=1) / (robust.sum(axis=1) + _PRIOR_POINTS)
        exposure -= exposure.mean()
        residuals = (differences - exposure[:, None]) / _MAX_RESIDUAL
        robust = seen / (1 + residuals**2)
    return exposure
