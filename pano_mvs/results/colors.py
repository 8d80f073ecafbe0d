"""Colours of figures: of cameras by their probability, and of other shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_RED_YELLOW_GREEN = np.array([(199, 38, 74), (250, 204, 77), (26, 153, 115)], np.float64)


def ramp_rgb(values: ArrayLike, stops: tuple[float, float, float]) -> NDArray[np.uint8]:
    """Return the colours (..., 3) of values (...), which are red, yellow and green at three increasing stops."""
    found = np.asarray(values, np.float64)
    channels = [np.interp(found, stops, _RED_YELLOW_GREEN[:, idx]) for idx in range(3)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def probability_color(probability: float) -> str:
    """Return the colour of a probability that a pose is right, as `#rrggbb`."""
    # As likely wrong, the default limit of a doubt, and as sure as can be.
    return f"#{bytes(ramp_rgb(probability, (0.5, 5 / 6, 0.99))).hex()}"
