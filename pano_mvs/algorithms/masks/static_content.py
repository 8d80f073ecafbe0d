"""Find what moves with the camera: tripod, rig, stick, the hand that holds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Annotated, Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import (
    DARK_LEVEL,
    area_labels,
    dilated,
    large_areas,
    opened_areas,
    pixel_weights,
    share_of_sphere,
)
from pano_mvs.algorithms.panoramas import contrast_around, largest_channel, mean_around
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pad_panorama, ray_grid, rotate_panorama

Plane = NDArray[np.float32]
_Compared: TypeAlias = "tuple[Plane, Plane, Plane]"

_PAD = 8
# At most this many pairs are compared, spread over all of them.
_MAX_PAIRS = 24
# The share of pairs that may disagree, such as those of a view in which a hand was elsewhere.
_DISAGREEING = 0.2
_TILT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


class FrameAgreement:
    """How well panoramas of one camera agree at the same pixels of their own frames: statistics over pairs of them.

    Windows are compared by zero-mean normalised cross-correlation (ZNCC), which does not depend on exposure. Each of
    the planes, (H, W) float32, is computed when it is asked for.

    Args:
        pictures: panoramas of one size, (H, W, 3) uint8 RGB.
    """

    def __init__(self, pictures: Sequence[Picture]) -> None:
        self._pairs = evenly_spread_pairs(len(pictures))
        # Beyond this elevation, windows are compared in a chart whose poles lie on the horizon of the first.
        self._polar = np.abs(ray_grid((pictures[0].shape[0], pictures[0].shape[1]))[..., 1]) > np.sin(np.pi / 4)
        tilted = [rotate_panorama(picture, _TILT) for picture in pictures]
        self._charts = [[_windows(picture) for picture in chart] for chart in (pictures, tilted)]
        self._same = [[_zncc(chart[i], chart[j]) for i, j in self._pairs] for chart in self._charts]

    @cached_property
    def contrast(self) -> Plane:
        """Median standard deviation of the windows, in grey levels."""
        variances = ([variance for _, _, variance in chart] for chart in self._charts)
        upright, tilted = (np.sqrt(np.maximum(_quantile(each, 0.5), 0)).astype(np.float32) for each in variances)
        return self._joined(upright, tilted)

    @cached_property
    def agreement(self) -> Plane:
        """ZNCC of windows at the same pixel, exceeded by four fifths of the pairs."""
        return self._joined(*(_quantile(same, _DISAGREEING) for same in self._same))

    @cached_property
    def sharpness(self) -> Plane:
        """By how much that ZNCC exceeds the best one a pixel away, exceeded by four fifths of the pairs.

        It is positive only where structure in all directions agrees to a fraction of a pixel: edges alone agree along
        themselves, and distant content is displaced a little.
        """
        around = ([_best_around(chart[i], chart[j], step=1) for i, j in self._pairs] for chart in self._charts)
        return self._joined(
            *(
                _quantile([here - best for here, best in zip(same, each, strict=True)], _DISAGREEING)
                for same, each in zip(self._same, around, strict=True)
            )
        )

    @cached_property
    def still(self) -> Plane:
        """The best ZNCC within three pixels, exceeded by a quarter of the pairs.

        It is small where the world moves between nearly all views.
        """
        around = ([_best_around(chart[i], chart[j], step=3) for i, j in self._pairs] for chart in self._charts)
        return self._joined(
            *(
                _quantile([np.maximum(here, best) for here, best in zip(same, each, strict=True)], 0.75)
                for same, each in zip(self._same, around, strict=True)
            )
        )

    def _joined(self, upright: Plane, tilted: Plane) -> Plane:
        """Return the plane of the first chart with the poles of the second, without their margins."""
        upright, tilted = (plane[_PAD:-_PAD, _PAD:-_PAD] for plane in (upright, tilted))
        return np.where(self._polar, rotate_panorama(tilted, _TILT.T), upright)


def evenly_spread_pairs(count: int) -> list[tuple[int, int]]:
    """Return at most 24 pairs of `count` views, evenly spread over all pairs."""
    pairs = [(first, second) for first in range(count) for second in range(first + 1, count)]
    if len(pairs) <= _MAX_PAIRS:
        return pairs
    return [pairs[idx] for idx in np.rint(np.linspace(0, len(pairs) - 1, _MAX_PAIRS)).astype(int)]


def color_difference(pictures: Sequence[Picture], gains: NDArray[np.float64]) -> Plane:
    """Return the largest difference of a channel in grey levels, (H, W), that four fifths of the pairs do not exceed.

    `pictures`: (H, W, 3) uint8 RGB each. `gains`: (V, 3) factor by which the channels of each picture are multiplied.
    """
    smooth = [mean_around(picture) * gain.astype(np.float32) for picture, gain in zip(pictures, gains, strict=True)]
    apart = [largest_channel(np.abs(smooth[i] - smooth[j])) for i, j in evenly_spread_pairs(len(pictures))]
    return _quantile(apart, 1 - _DISAGREEING)


def _quantile(planes: Sequence[NDArray[Any]], share: float) -> Plane:
    """Return the quantile of each pixel over some planes, in a sixth of the time of numpy's."""
    ordered, place = np.sort(planes, axis=0), share * (len(planes) - 1)
    below, above = ordered[int(place)], ordered[min(int(place) + 1, len(planes) - 1)]
    return np.asarray(below + (above - below) * np.float32(place % 1), np.float32)


def _windows(picture: Picture) -> _Compared:
    """Return grey levels with a margin, and the mean and the variance of the window around each pixel."""
    grey = pad_panorama(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), _PAD).astype(np.float32)
    mean = _mean(grey)
    return grey, mean, _mean(grey * grey) - mean * mean


def _mean(values: Plane) -> Plane:
    return np.asarray(cv2.blur(values, (7, 7)), np.float32)


def _zncc(first: _Compared, second: _Compared) -> Plane:
    covariance = _mean(first[0] * second[0]) - first[1] * second[1]
    return np.asarray(covariance / np.sqrt(np.maximum(first[2] * second[2], 1e-3)), np.float32)


def _best_around(first: _Compared, second: _Compared, *, step: int) -> Plane:
    """Return the best ZNCC with windows `step` pixels away in eight directions."""
    best = np.full_like(first[0], -1)
    for y, x in product((-1, 0, 1), repeat=2):
        if not (y or x):
            continue
        grey, mean, variance = (np.roll(plane, (step * y, step * x), (0, 1)) for plane in second)
        np.maximum(best, _zncc(first, (grey, mean, variance)), out=best)
    return best


MIN_VIEWS = 3
"""With fewer views, chance agreement cannot be distinguished from content that moves with the camera."""

MAX_VIEWS = 12
"""More views than this add nothing; give an evenly spread choice."""

_MIN_WIDTH = 128
_CLOSING_PX = 2


@dataclass(frozen=True, slots=True, eq=False)
class StaticContent:
    """What moves with the camera.

    `pixels`: (H, W) bool at `WIDTH` columns or fewer, True where it is. `reason`: why nothing could be looked for; ""
    if it could.
    """

    pixels: Mask
    reason: str = ""


@checks_settings
def static_content(
    pictures: Sequence[Picture],
    valid: Sequence[Mask] | None = None,
    *,
    min_area_deg2: Annotated[float, Setting("minimum size of an area, in square degrees", ge=0)] = 20.0,
    margin_deg: Annotated[float, Setting("angle by which areas are dilated", ge=0, le=20)] = 0.7,
) -> StaticContent:
    """Return the pixels that show the same in nearly all panoramas of a camera, while the world around them moves.

    Seeds are windows whose structure, in all directions, agrees to a fraction of a pixel between four fifths of the
    pairs. Distant content, the surroundings of the epipoles and edges parallel to the motion do not: they are displaced
    a little, or agree along themselves as well. Seeds grow along agreeing edges, and into plain areas of the same
    colour that the agreeing edges enclose. An area is kept if the structure around it moves by more than three pixels
    between most pairs, which is not so around distant content.

    Args:
        pictures: three or more panoramas of one camera from different places, (H, W, 3) uint8 RGB of one size, at most
            `WIDTH` columns.
        valid: (H, W) of each, False is ignored.

    Raises:
        UsageError: if the pictures differ in size, or a setting is out of bounds.
    """
    if not pictures or any(picture.shape != pictures[0].shape for picture in pictures):
        raise UsageError("static content needs panoramas of one size")
    size_hw = (pictures[0].shape[0], pictures[0].shape[1])
    nothing = np.zeros(size_hw, np.bool_)
    if len(pictures) < MIN_VIEWS:
        return StaticContent(nothing, f"{MIN_VIEWS} panoramas of a camera are needed, it has {len(pictures)}")
    if size_hw[1] < _MIN_WIDTH:
        return StaticContent(nothing, f"panoramas of at least {_MIN_WIDTH} columns are needed")
    agreement = FrameAgreement(pictures)
    usable = np.ones(size_hw, np.bool_)
    if valid is not None and not all(mask.all() for mask in valid):  # windows that are not masked anywhere
        usable = ~dilated(~np.logical_and.reduce(list(valid)), 4)
    # A window has structure from this standard deviation on, in grey levels.
    structure = (agreement.contrast >= 4.0) & usable
    areas = _seeded_areas(agreement, structure)
    moved = structure & ((agreement.still if areas else agreement.agreement) < 0.75)  # at least as small as the former
    # The share of the sphere that has to move between the views, or they may all be of one place.
    if share_of_sphere(moved) < 0.03:
        return StaticContent(nothing, "the panoramas do not differ enough: are they all of one place?")
    core = _in_moving_surroundings(areas, structure, moved)
    if not core.any():
        return StaticContent(nothing)
    found = large_areas(_with_enclosed_parts(core, pictures, plain=usable & ~structure), min_area_deg2)
    margin = round(margin_deg * size_hw[0] / 180)
    return StaticContent(dilated(found, margin) if margin and found.any() else found)


def _seeded_areas(agreement: FrameAgreement, structure: Mask) -> list[Mask]:
    """Return connected areas of agreeing structure that contain seeds."""
    agrees, seeds = structure & (agreement.agreement >= 0.5), structure & (agreement.agreement >= 0.7)
    if not _areas_with(seeds, agrees):
        return []  # in most captures, and what follows takes most of the time
    seeds &= agreement.sharpness >= 0.03
    return _areas_with(seeds, (agrees & (agreement.sharpness >= -0.02)) | seeds)


def _areas_with(seeds: Mask, pixels: Mask) -> list[Mask]:
    """Return the connected areas of some pixels that contain enough seeds."""
    labels, weights = area_labels(pixels), pixel_weights(seeds.shape)
    enough = np.bincount(labels[seeds], weights[seeds], labels.size) >= 12
    return [labels == label for label in np.flatnonzero(enough)]


def _in_moving_surroundings(areas: Sequence[Mask], structure: Mask, moved: Mask) -> Mask:
    """Return the areas, as one mask, around which most of the structure moves between the views."""
    weights = pixel_weights(structure.shape)
    found = np.zeros_like(structure)
    for area in areas:
        # Around content that moves with the camera, at least this share of the structure moves.
        ring = dilated(area, 6) & ~dilated(area, 1)
        structured = float(weights[ring & structure].sum())
        if structured >= 0.1 * weights[ring].sum() and weights[ring & moved].sum() >= 0.35 * structured:
            found |= area
    return found


def _with_enclosed_parts(core: Mask, pictures: Sequence[Picture], *, plain: Mask) -> Mask:
    """Return areas with the parts beside them that are plain or have the same colour in all views.

    A part belongs to them if most of its border lies on them, or on edges that most views show at the same place, such
    as the outline of a hand before a moving world. A plain floor has no such outline.
    """
    brightness = np.median([largest_channel(picture) for picture in pictures], axis=0)
    # How much colours may differ: in grey levels, and as a share of the brightness.
    alike = color_difference(pictures, _gains(pictures, core)) <= 8.0 + 0.05 * brightness
    closed = ~dilated(~dilated(core, _CLOSING_PX), _CLOSING_PX) | core
    # Beside which three fifths of the views have an edge.
    edges = _quantile([contrast_around(picture, 1) for picture in pictures], 0.4) >= 12
    outline = closed | edges
    parts = opened_areas((alike | plain) & ~closed, 1)
    labels, weights = area_labels(parts), pixel_weights(core.shape)
    result = closed.copy()
    for label in np.unique(labels[parts & dilated(closed, 1)]):
        area = labels == label
        border = dilated(area, 1) & ~area
        # A part belongs to the content beside it if this share of its border lies on it, or on an outline.
        if weights[border & outline].sum() >= 0.5 * weights[border].sum():
            result |= area
    labels = area_labels(~result)
    weights = pixel_weights(result.shape)
    sizes = np.bincount(labels[~result], weights[~result], labels.size)
    result[~result] = sizes[labels[~result]] < 0.05 * weights.sum() * (sizes.max() > 0.5 * sizes.sum())
    # Windows that agree reach over the outline by most of their radius.
    return np.asarray((result & alike) | ~dilated(~result, 3))


def _gains(pictures: Sequence[Picture], pixels: Mask) -> NDArray[np.float64]:
    """Return factors (V, 3) that give most of some pixels the same colour in all views."""
    inner = pixels & ~dilated(~pixels, _CLOSING_PX)
    levels = np.array([picture[inner if inner.any() else pixels] for picture in pictures]) + DARK_LEVEL
    return np.asarray(np.median(np.median(levels, axis=0) / levels, axis=1))
