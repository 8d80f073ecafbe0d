"""How well the panoramas of a capture agree pixel by pixel in the camera frame, whatever the cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.channels import largest_channel
from pano_mvs.core.arrays import Picture
from pano_mvs.geometry import pad_panorama, ray_grid, rotate_panorama

Plane = NDArray[np.float32]
_Compared: TypeAlias = "tuple[Plane, Plane, Plane]"

_RADIUS = 3
_PAD = 8
_FAR_STEP = 3
# At most this many pairs are compared, spread over all of them.
_MAX_PAIRS = 24
# The share of pairs that may disagree, such as those of a view in which a hand was elsewhere.
_DISAGREEING = 0.2
# Beyond this elevation, windows are compared in a chart whose poles lie on the horizon of the first.
_CHART_LIMIT = np.pi / 4
_TILT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_AROUND = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x)


@dataclass(frozen=True, eq=False)
class FrameAgreement:
    """Statistics over pairs of panoramas, each (H, W) float32.

    Windows are compared by zero-mean normalised cross-correlation (ZNCC), which does not depend on exposure.

    Attributes:
        contrast: median standard deviation of the windows, in grey levels.
        agreement: ZNCC of windows at the same pixel, exceeded by four fifths of the pairs.
        sharpness: by how much that ZNCC exceeds the best one a pixel away, exceeded by four fifths of the pairs.
            Positive only where structure in all directions agrees to a fraction of a pixel: edges alone agree along
            themselves, and distant content is displaced a little.
        still: the best ZNCC within three pixels, exceeded by a quarter of the pairs. It is small where the world moves
            between nearly all views.
    """

    contrast: Plane
    agreement: Plane
    sharpness: Plane
    still: Plane


def frame_agreement(pictures: Sequence[Picture]) -> FrameAgreement:
    """Return how well panoramas of one size, (H, W, 3) uint8 RGB, agree at the same pixels of their own frames."""
    upright = _chart_agreement(pictures)
    tilted = _chart_agreement([rotate_panorama(picture, _TILT) for picture in pictures])
    size_hw = (pictures[0].shape[0], pictures[0].shape[1])
    polar = np.abs(ray_grid(size_hw)[..., 1]) > np.sin(_CHART_LIMIT)
    return FrameAgreement(
        *(
            np.where(polar, rotate_panorama(getattr(tilted, field.name), _TILT.T), getattr(upright, field.name))
            for field in fields(FrameAgreement)
        )
    )


def evenly_spread_pairs(count: int) -> list[tuple[int, int]]:
    """Return at most 24 pairs of `count` views, evenly spread over all pairs."""
    pairs = [(first, second) for first in range(count) for second in range(first + 1, count)]
    if len(pairs) <= _MAX_PAIRS:
        return pairs
    return [pairs[idx] for idx in np.rint(np.linspace(0, len(pairs) - 1, _MAX_PAIRS)).astype(int)]


def color_difference(pictures: Sequence[Picture], gains: NDArray[np.float64]) -> Plane:
    """Return the largest difference of a channel in grey levels, (H, W), that four fifths of the pairs do not exceed.

    Args:
        pictures: (H, W, 3) uint8 RGB each.
        gains: (V, 3) factor by which the channels of each picture are multiplied.
    """
    smooth = [
        cv2.blur(pad_panorama(picture, 1).astype(np.float32), (3, 3))[1:-1, 1:-1] * gain.astype(np.float32)
        for picture, gain in zip(pictures, gains, strict=True)
    ]
    apart = [largest_channel(np.abs(smooth[i] - smooth[j])) for i, j in evenly_spread_pairs(len(pictures))]
    return np.asarray(np.quantile(apart, 1 - _DISAGREEING, axis=0), np.float32)


def _chart_agreement(pictures: Sequence[Picture]) -> FrameAgreement:
    compared = [_windows(picture) for picture in pictures]
    same, sharper, still = [], [], []
    for first, second in evenly_spread_pairs(len(pictures)):
        here = _zncc(compared[first], compared[second])
        same.append(here)
        sharper.append(here - _best_around(compared[first], compared[second], step=1))
        still.append(np.maximum(here, _best_around(compared[first], compared[second], step=_FAR_STEP)))
    inner = (slice(_PAD, -_PAD), slice(_PAD, -_PAD))
    variance = np.median([variance for _, _, variance in compared], axis=0)
    return FrameAgreement(
        contrast=np.sqrt(np.maximum(variance, 0)).astype(np.float32)[inner],
        agreement=np.quantile(same, _DISAGREEING, axis=0).astype(np.float32)[inner],
        sharpness=np.quantile(sharper, _DISAGREEING, axis=0).astype(np.float32)[inner],
        still=np.quantile(still, 0.75, axis=0).astype(np.float32)[inner],
    )


def _windows(picture: Picture) -> _Compared:
    """Return grey levels with a margin, and the mean and the variance of the window around each pixel."""
    grey = pad_panorama(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), _PAD).astype(np.float32)
    mean = _mean(grey)
    return grey, mean, _mean(grey * grey) - mean * mean


def _mean(values: Plane) -> Plane:
    side = 2 * _RADIUS + 1
    return np.asarray(cv2.blur(values, (side, side)), np.float32)


def _zncc(first: _Compared, second: _Compared) -> Plane:
    covariance = _mean(first[0] * second[0]) - first[1] * second[1]
    return np.asarray(covariance / np.sqrt(np.maximum(first[2] * second[2], 1e-3)), np.float32)


def _best_around(first: _Compared, second: _Compared, *, step: int) -> Plane:
    """Return the best ZNCC with windows `step` pixels away in eight directions."""
    best = np.full_like(first[0], -1)
    for y, x in _AROUND:
        grey, mean, variance = (np.roll(plane, (step * y, step * x), (0, 1)) for plane in second)
        np.maximum(best, _zncc(first, (grey, mean, variance)), out=best)
    return best
