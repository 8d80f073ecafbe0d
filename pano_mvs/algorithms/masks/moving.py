"""Find what moves through the scene: the operator, passers-by and vehicles, from views with poses and ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.masks.areas import (
    SQUARE_DEG_OF_SPHERE,
    area_labels,
    area_sizes,
    border_shares,
    dilated,
    off_nadir_deg,
    opened_areas,
    pixel_weights,
)
from pano_mvs.algorithms.masks.expected_view import Expected, OtherView, expected_view
from pano_mvs.algorithms.masks.people import person_at
from pano_mvs.algorithms.masks.person_views import SeenPanorama
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import ray_grid
from pano_mvs.scene import RangeMap

MAX_OTHERS = 6
"""More views around a panorama add nothing."""

# The mean probability of a person, by the network: of an area below the camera, where an operator is expected, and of
# others. Furniture that the other views hide can have 0.77, and has 0.00 below the camera.
_OPERATOR, _PERSON = 0.04, 0.85


@dataclass(frozen=True, slots=True, eq=False)
class Moving:
    """What moves through the scene, (H, W) each.

    `pixels`: what is found, dilated. `shadow`: the shadows beside it, or nothing if they were not asked for; a part of
    `pixels`.
    """

    pixels: Mask
    shadow: Mask


@checks_settings
def moving_pixels(
    picture: Picture,
    range_map: RangeMap,
    others: Sequence[OtherView],
    *,
    valid: Mask,
    passers_by: Annotated[bool, Setting("also find people at a distance, not only the operator")] = True,
    vehicles: Annotated[bool, Setting("outdoors, also find areas with the size and the shape of vehicles")] = True,
    shadows: Annotated[bool, Setting("also mask the shadows on the ground beside what is found")] = False,
    min_area_deg2: Annotated[float, Setting("minimum size of an area, in square degrees", ge=0)] = 12.0,
    margin_deg: Annotated[float, Setting("angle by which areas are dilated", ge=0, le=20)] = 1.0,
) -> Moving:
    """Return the pixels of a panorama whose colours contradict all other views, and that look like people or vehicles.

    The other views expect surfaces (`expected_view`). Where the colour differs from everything that they show there,
    and around it, the panorama shows something that was there only then. Such an area is accepted if it extends an
    area of the operator that is masked already; or if the network of `people` finds a person in it, where less is
    enough below the camera; or if it stands on the ground and has the size of a vehicle. Other areas, such as
    reflections and things that the other views do not see, are ignored. Darker areas with unchanged hue on the ground
    are shadows.

    Args:
        picture: (H, W, 3) uint8 RGB, at most `WIDTH` columns, masked pixels filled.
        range_map: its ranges, of the same size, checked against those of the other views.
        others: two or more views around it.
        valid: (H, W), False is masked already.

    Raises:
        UsageError: if the arrays differ in size, or a setting is out of bounds.
    """
    size_hw = (picture.shape[0], picture.shape[1])
    if range_map.range.shape != size_hw or valid.shape != size_hw:
        raise UsageError(f"a panorama of {size_hw} needs ranges and a mask of its size, got {range_map.range.shape}")
    nothing = np.zeros(size_hw, np.bool_)
    if len(others) < 2 or size_hw[0] < 16:
        return Moving(nothing, nothing)
    expected = expected_view(picture, range_map, others)
    # Differences of colour, in grey levels, from which an area is changed; somewhere in it, they are larger.
    changed = np.nan_to_num(expected.difference, nan=0.0) > 10.0
    # A shadow makes the ground darker than expected, by the same factor in all channels.
    ratio = np.nan_to_num(expected.ratio, nan=1.0)
    mean = ratio.mean(axis=-1)
    tint = (ratio.max(axis=-1) - ratio.min(axis=-1)) / np.maximum(mean, 1e-6)
    shadow = expected.ground & (mean > 0.28) & (mean < 0.88) & (tint < 0.13) & valid
    found = nothing.copy()
    seen = SeenPanorama(picture)
    vehicles = vehicles and not _has_ceiling(expected)
    for area in _areas(changed & valid & ~shadow, expected, min_area_deg2):
        if _extends_mask(area, ~valid) or (vehicles and _is_vehicle(area, expected)):
            found |= area
        else:
            found |= _person_in(seen, area, passers_by=passers_by)
    cast = nothing
    if shadows:  # those that touch what is found
        labels = area_labels(np.asarray(shadow & ~(found | ~valid)))
        touched = np.unique(labels[dilated(found | ~valid, 2) & (labels >= 0)])
        cast = np.isin(labels, touched) & (labels >= 0)
    margin = round(margin_deg * size_hw[0] / 180)
    everything = found | cast
    return Moving(dilated(everything, margin) & valid if margin else everything, cast)


def _areas(changed: Mask, expected: Expected, min_area_deg2: float) -> list[Mask]:
    """Return the connected areas that are large enough and certain."""
    opened = opened_areas(changed, 1)
    labels, weights = area_labels(opened), pixel_weights(changed.shape)
    sizes = area_sizes(labels, weights)
    certain = opened & (np.nan_to_num(expected.difference) > 24.0)
    share = np.bincount(labels[certain], weights[certain], labels.size) / np.maximum(sizes, 1e-9)
    least = min_area_deg2 / SQUARE_DEG_OF_SPHERE * weights.sum()
    return [labels == label for label in np.flatnonzero((sizes >= least) & (share >= 0.15))]


def _extends_mask(area: Mask, masked: Mask) -> bool:
    """Return whether an area lies within the operator's reach and extends what is masked there."""
    if not masked.any():
        return False
    weights = pixel_weights(area.shape)
    within = area & (off_nadir_deg((area.shape[0], area.shape[1])) < 75.0)
    if weights[within].sum() < 0.9 * weights[area].sum():
        return False
    labels = np.where(area, 0, -1).astype(np.int64)
    return bool(border_shares(labels, dilated(masked, 1))[0] > 0.15)


def _person_in(seen: SeenPanorama, area: Mask, *, passers_by: bool) -> Mask:
    """Return an area if it is the operator, or with the pixels of the person in it; nothing if neither."""
    # The operator reaches to within this angle of straight down.
    below = bool(off_nadir_deg((area.shape[0], area.shape[1]))[area].min() < 30.0)
    nobody = np.zeros_like(area)
    if not below and not passers_by:
        return nobody
    probability, pixels = person_at(seen, area, least=_OPERATOR if below else _PERSON)
    if passers_by and probability >= _PERSON:
        # As far around an area, the network's pixels belong to the person.
        reach = max(1, round(4.0 * len(area) / 180))
        return area | (pixels & dilated(area, reach))
    return area if below and probability >= _OPERATOR else nobody


def _is_vehicle(area: Mask, expected: Expected) -> bool:
    """Return whether an area stands on the ground and has the extent of a vehicle."""
    if not np.isfinite(expected.height):
        return False
    # It hides the ground, and ends on it.
    below = np.roll(area, 2, axis=0) & ~area
    if expected.ground[area].mean() < 0.15 or expected.ground[below].mean() < 0.5:
        return False
    rays = ray_grid((area.shape[0], area.shape[1]))
    elevation = np.arcsin(-rays[..., 1])[area]
    bottom, top = float(np.quantile(elevation, 0.02)), float(np.quantile(elevation, 0.98))
    if not (np.radians(-60) < bottom < np.radians(-3)):
        return False
    distance = 1 / np.tan(-bottom)  # in heights of the camera, and so are the following
    height = 1 + distance * np.tan(min(top, 1.3))
    center = rays[area].mean(axis=0)
    azimuth = np.angle(np.exp(1j * (np.arctan2(rays[..., 0], rays[..., 2])[area] - np.arctan2(center[0], center[2]))))
    width = float(np.quantile(azimuth, 0.98) - np.quantile(azimuth, 0.02))
    length = 2 * distance * np.tan(min(width / 2, 1.3))
    filled = area.sum() / max((top - bottom) * width * (area.shape[0] / np.pi) ** 2, 1)
    # A vehicle fills much of its outline.
    return bool(0.8 < length < 4.5 and 0.35 < height < 1.5 and filled > 0.55)


def _has_ceiling(expected: Expected) -> bool:
    """Return whether other views see a surface not far above the camera."""
    size_hw = (expected.ranges.shape[0], expected.ranges.shape[1])
    above = expected.ranges[off_nadir_deg(size_hw) > 180 - 45]
    known = above[np.isfinite(above)]
    # There are no vehicles in rooms: the ceiling is at most as many heights of the camera away.
    return bool(len(known) > 0.5 * len(above) and np.median(known) < 4 * expected.height)
