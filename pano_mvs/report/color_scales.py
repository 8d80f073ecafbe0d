"""Colour scales of the views: their ranges, on a common scale and on one of each view, confidence and uncertainty."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.images.preview import scale_ticks
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, WEAK_CONFIDENCE

_TICKS_APART = 0.09
# Relative standard deviations from this one (dark) to this one (bright), on a logarithmic scale.
UNCERTAINTY_LIMITS = 0.001, 0.2
# A view has a scale of its own only if an end of it differs from the common scale by more than this factor.
_SAME_SCALE = 1.1
# Colours of the low and high end of each class, distinguishable for colour-blind readers and in grey.
_CLASSES = (
    (FILLED_CONFIDENCE, (150, 95, 160), (196, 140, 204)),
    (WEAK_CONFIDENCE, (200, 130, 20), (245, 180, 60)),
    (CONSISTENT_CONFIDENCE, (10, 90, 110), (60, 190, 190)),
)
_INVALID = (96, 96, 96)


Ticks = tuple[tuple[float, float], ...]
Limits = tuple[float, float]


@dataclass(frozen=True)
class RangeScales:
    """The nearest and the farthest range of the colour scales of a view.

    Attributes:
        common: of all views of its group.
        own: of this view; None if it has no ranges.
    """

    common: Limits
    own: Limits | None

    @property
    def differ(self) -> bool:
        """Whether the view looks different on its own scale."""
        ratios = [a / b for a, b in zip(self.common, self.own or self.common, strict=True)]
        return any(max(ratio, 1 / ratio) > _SAME_SCALE for ratio in ratios)

    @property
    def range_part(self) -> str:
        """The last part of the key of the range on the common scale."""
        return f"range{zlib.crc32(repr(self.common).encode()):08x}"


def common_limits(own: Mapping[str, Limits | None], groups: Mapping[str, int]) -> dict[int, Limits]:
    """Return the limits that suit all views of each group."""
    found: dict[int, list[Limits]] = {}
    for name, limits in own.items():
        if limits is not None:
            found.setdefault(groups.get(name, 0), []).append(limits)
    return {group: (min(near for near, _ in limits), max(far for _, far in limits)) for group, limits in found.items()}


def range_ticks(near: float, far: float) -> Ticks:
    """Return the ticks of a colour scale of ranges, spaced so that no two labels overlap."""
    found: list[tuple[float, float]] = []
    for value in scale_ticks(near, far):
        at = round(float(np.log(value / near) / np.log(far / near)), 4)
        if 0.02 < at < 0.98 and (not found or at - found[-1][0] >= _TICKS_APART):
            found.append((at, value))
    return tuple(found)


def confidence_colors(confidence: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return RGB colours (H, W, 3) of confidences (H, W): a hue per class, brighter if higher; invalid is grey."""
    table = np.empty((256, 3), np.uint8)
    table[0] = _INVALID
    for (low, high), dark, bright in _CLASSES:
        share = np.linspace(0, 1, high - low + 1)[:, None]
        table[low : high + 1] = np.rint((1 - share) * np.array(dark) + share * np.array(bright))
    return table[confidence]


def uncertainty_colors(uncertainty: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return relative standard deviations (H, W) in colours (H, W, 3) RGB, from dark to bright; invalid is grey."""
    low, high = np.log(UNCERTAINTY_LIMITS)
    known = np.isfinite(uncertainty)
    share = (np.log(np.where(known, uncertainty, 1).astype(np.float32)) - low) / (high - low)
    colors = cv2.applyColorMap(np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8), cv2.COLORMAP_CIVIDIS)
    rgb: NDArray[np.uint8] = cv2.cvtColor(colors, cv2.COLOR_BGR2RGB)
    rgb[~known] = _INVALID
    return rgb
