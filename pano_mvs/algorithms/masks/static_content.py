"""Find what moves with the camera: tripod, rig, stick, the hand that holds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.channels import largest_channel
from pano_mvs.algorithms.masks.areas import area_labels, dilated, pixel_weights, share_of_sphere
from pano_mvs.algorithms.masks.frame_agreement import FrameAgreement, color_difference, frame_agreement
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene.masking import placed_mask

MIN_VIEWS = 3
"""With fewer views, chance agreement cannot be distinguished from content that moves with the camera."""

MAX_VIEWS = 12
"""More views than this add nothing; give an evenly spread choice."""

WIDTH = 512
"""Columns at which panoramas are compared."""

_MIN_WIDTH = 128
# A window has structure from this standard deviation on, in grey levels.
_MIN_CONTRAST = 4.0
_SEED_AGREEMENT, _SEED_SHARPNESS = 0.7, 0.03
_GROWN_AGREEMENT, _GROWN_SHARPNESS = 0.5, -0.02
_MOVED = 0.75
# The share of the sphere that has to move between the views, or they may all be of one place.
_MIN_MOVED_SHARE = 0.03
_MIN_SEED_PX = 12
# How much colours may differ: in grey levels, and as a share of the brightness.
_MAX_DIFFERENCE, _MAX_CHANGE = 8.0, 0.05
_DARK_LEVEL = 4.0
# Around content that moves with the camera, at least this share of the structure moves.
_RING_PX, _MIN_RING_MOVED, _MIN_RING_STRUCTURE = 6, 0.35, 0.1
# A part belongs to the content beside it if this share of its border lies on it, or on an outline.
_MIN_ENCLOSED = 0.5
_MIN_EDGE = 12
_CLOSING_PX, _OVERHANG_PX = 2, 3
_SQUARE_DEG_OF_SPHERE = 4 * np.pi * np.degrees(1) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class StaticContent:
    """What moves with the camera.

    Attributes:
        pixels: (H, W) bool at `WIDTH` columns or fewer, True where it is.
        reason: why nothing could be looked for; "" if it could.
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
        min_area_deg2: minimum size of an area.
        margin_deg: angle by which areas are dilated, to include their soft edges.

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
    agreement = frame_agreement(pictures)
    usable = _usable(valid, size_hw)
    structure = (agreement.contrast >= _MIN_CONTRAST) & usable
    moved = structure & (agreement.still < _MOVED)
    if share_of_sphere(moved) < _MIN_MOVED_SHARE:
        return StaticContent(nothing, "the panoramas do not differ enough: are they all of one place?")
    core = _grown(agreement, structure, moved)
    if not core.any():
        return StaticContent(nothing)
    found = _large(_with_enclosed_parts(core, pictures, plain=usable & ~structure), min_area_deg2)
    margin = round(margin_deg * size_hw[0] / 180)
    return StaticContent(dilated(found, margin) if margin and found.any() else found)


def reduced_to_width(picture: Picture, valid: Mask) -> tuple[Picture, Mask]:
    """Return a panorama and its mask at `WIDTH` columns; smaller ones as they are."""
    height, width = valid.shape
    if width <= WIDTH:
        return picture, valid
    size_hw = (WIDTH // 2, WIDTH)
    small = cv2.resize(picture, size_hw[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(small), placed_mask(valid, size_hw, of=(0, 0, width, height), whole_hw=(height, width))


def _usable(valid: Sequence[Mask] | None, size_hw: tuple[int, int]) -> Mask:
    """Return the pixels, (H, W), whose windows are not masked in any panorama."""
    if valid is None or all(mask.all() for mask in valid):
        return np.ones(size_hw, np.bool_)
    return ~dilated(~np.logical_and.reduce(list(valid)), 4)


def _grown(agreement: FrameAgreement, structure: Mask, moved: Mask) -> Mask:
    """Return connected areas of agreeing structure that contain seeds and lie in surroundings that move."""
    agrees = structure & (agreement.agreement >= _GROWN_AGREEMENT) & (agreement.sharpness >= _GROWN_SHARPNESS)
    seeds = structure & (agreement.agreement >= _SEED_AGREEMENT) & (agreement.sharpness >= _SEED_SHARPNESS)
    labels = area_labels(agrees | seeds)
    weights = pixel_weights(seeds.shape)
    enough = np.bincount(labels[seeds], weights[seeds], labels.size) >= _MIN_SEED_PX
    found = np.zeros_like(seeds)
    for label in np.flatnonzero(enough):
        area = labels == label
        ring = dilated(area, _RING_PX) & ~dilated(area, 1)
        structured = float(weights[ring & structure].sum())
        if (
            structured >= _MIN_RING_STRUCTURE * weights[ring].sum()
            and weights[ring & moved].sum() >= _MIN_RING_MOVED * structured
        ):
            found |= area
    return found


def _with_enclosed_parts(core: Mask, pictures: Sequence[Picture], *, plain: Mask) -> Mask:
    """Return areas with the parts beside them that are plain or have the same colour in all views.

    A part belongs to them if most of its border lies on them, or on edges that most views show at the same place, such
    as the outline of a hand before a moving world. A plain floor has no such outline.
    """
    brightness = np.median([largest_channel(picture) for picture in pictures], axis=0)
    alike = color_difference(pictures, _gains(pictures, core)) <= _MAX_DIFFERENCE + _MAX_CHANGE * brightness
    closed = ~dilated(~dilated(core, _CLOSING_PX), _CLOSING_PX) | core
    outline = closed | _lasting_edges(pictures)
    parts = _opened((alike | plain) & ~closed)
    labels, weights = area_labels(parts), pixel_weights(core.shape)
    result = closed.copy()
    for label in np.unique(labels[parts & dilated(closed, 1)]):
        area = labels == label
        border = dilated(area, 1) & ~area
        if weights[border & outline].sum() >= _MIN_ENCLOSED * weights[border].sum():
            result |= area
    result = _without_pinholes(result)
    # Windows that agree reach over the outline by most of their radius.
    return np.asarray((result & alike) | ~dilated(~result, _OVERHANG_PX))


def _gains(pictures: Sequence[Picture], pixels: Mask) -> NDArray[np.float64]:
    """Return factors (V, 3) that give most of some pixels the same colour in all views."""
    inner = pixels & ~dilated(~pixels, _CLOSING_PX)
    levels = np.array([picture[inner if inner.any() else pixels] for picture in pictures]) + _DARK_LEVEL
    return np.asarray(np.median(np.median(levels, axis=0) / levels, axis=1))


def _lasting_edges(pictures: Sequence[Picture]) -> Mask:
    """Return the pixels, (H, W), beside which three fifths of the views have an edge."""
    window = np.ones((3, 3), np.uint8)
    contrasts = []
    for picture in pictures:
        padded = np.ascontiguousarray(pad_panorama(picture, 1))
        contrast = cv2.dilate(padded, window).astype(np.int16) - cv2.erode(padded, window)
        contrasts.append(largest_channel(contrast[1:-1, 1:-1]))
    return np.asarray(np.quantile(contrasts, 0.4, axis=0) >= _MIN_EDGE)


def _opened(pixels: Mask) -> Mask:
    """Return areas without bridges and specks one or two pixels wide."""
    return np.asarray(dilated(~dilated(~pixels, 1), 1) & pixels)


def _without_pinholes(found: Mask) -> Mask:
    """Return areas with the small holes filled that no smaller area surrounds."""
    labels = area_labels(~found)
    weights = pixel_weights(found.shape)
    sizes = np.bincount(labels[~found], weights[~found], labels.size)
    filled = found.copy()
    filled[~found] = sizes[labels[~found]] < 0.05 * weights.sum() * (sizes.max() > 0.5 * sizes.sum())
    return filled


def _large(found: Mask, min_area_deg2: float) -> Mask:
    labels = area_labels(found)
    area_deg2 = pixel_weights(found.shape) * (_SQUARE_DEG_OF_SPHERE / pixel_weights(found.shape).sum())
    sizes = np.bincount(labels[found], area_deg2[found], labels.size)
    large = np.zeros_like(found)
    large[found] = sizes[labels[found]] >= min_area_deg2
    return large
