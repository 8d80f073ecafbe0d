"""Find people in a single panorama: the operator, and passers-by."""

from __future__ import annotations

from functools import cache
from typing import Annotated

import cv2
import numpy as np

from pano_mvs.algorithms.faces.layout import upright_rotation
from pano_mvs.algorithms.masks.areas import (
    SQUARE_DEG_OF_SPHERE,
    area_labels,
    dilated,
    large_areas,
    off_nadir_deg,
    pixel_weights,
)
from pano_mvs.algorithms.masks.person_upright import upright_people
from pano_mvs.algorithms.masks.person_views import MAP_HW, Look, Map, SeenPanorama, look, rolled
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import ray_grid

_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_NARROW_ROLLS_DEG = (0.0, 90.0, 180.0, 270.0)
_AT_NADIR_DEG = 2.0


def people_below(seen: SeenPanorama, min_area_deg2: float) -> Mask:
    """Return the pixels, `MAP_HW`, of people below the camera.

    Two networks look straight down, in several rotations and with two fields of view: one segments people, the other
    outlines what is in the middle. They have to agree on an area, and the second has to detect a person.
    """
    nobody = np.zeros(MAP_HW, np.bool_)
    narrow, wide = _looks()
    probable = [each.on_map(seen.probability(each)) for each in narrow]
    if not _areas_below(np.mean(probable, axis=0), min_area_deg2):
        return nobody
    probable += [each.on_map(seen.probability(each)) for each in wide]
    middles = [seen.middle(each) for each in narrow + wide]
    outlined = [each.on_map(outline) for each, (_, outline) in zip(narrow + wide, middles, strict=True)]
    areas = _areas_below(_mean_map([*probable, *outlined], (narrow + wide) * 2), min_area_deg2)
    present = max(presence for presence, _ in middles)
    accepted = [
        area
        for area in areas
        if _likely(probable, outlined, area) and _accepted(probable, outlined, area, present=present)
    ]
    return np.asarray(np.logical_or.reduce([nobody, *accepted]))


def _likely(probable: list[Map], outlined: list[Map], area: Mask) -> bool:
    """Return whether the networks find a person in an area: one in the narrow views, the other in all views."""
    found = _means(probable[: len(_NARROW_ROLLS_DEG)], area)
    if np.mean(_means(outlined, area)) < 0.75:
        return False
    if off_nadir_deg(MAP_HW)[area].min() < _AT_NADIR_DEG and np.mean(found) >= 0.6:
        return True
    # What the narrow views give for the pixels of a person: on average, and at least. Furniture fails in some rotation.
    # What contains the nadir itself, such as a rig, may fail in one, but has to be outlined in all views.
    return bool(np.mean(found) >= 0.75 and min(found) >= 0.5)


def _accepted(probable: list[Map], outlined: list[Map], area: Mask, *, present: float) -> bool:
    """Return whether an area that is likely is a person, or what is fixed below the camera.

    `present`: how likely the views show a person, at most.
    """
    at_nadir = off_nadir_deg(MAP_HW)[area].min() < _AT_NADIR_DEG
    if at_nadir and np.mean(_means(outlined, area)) >= 0.85:
        return True
    # The wide views may fail if one of the views shows a person for certain.
    wide_agree = np.mean(_means(probable[len(_NARROW_ROLLS_DEG) :], area)) >= 0.6
    return present >= (0.5 if at_nadir or wide_agree else 0.9)


def _areas_below(mean: Map, min_area_deg2: float) -> list[Mask]:
    """Return the connected areas near the nadir that are probable and large enough."""
    labels, weights = area_labels(mean > 0.5), pixel_weights(MAP_HW)
    # A person reaches to within this angle of the nadir.
    near = np.unique(labels[(off_nadir_deg(MAP_HW) < 30.0) & (labels >= 0)])
    least = min_area_deg2 / SQUARE_DEG_OF_SPHERE * weights.sum()
    areas = (labels == label for label in near)
    return [area for area in areas if weights[area].sum() >= least]


def _means(maps: list[Map], area: Mask) -> list[float]:
    """Return the mean of each map over what it shows of an area."""
    weights = pixel_weights(MAP_HW)[area]
    return [float(np.average(values[area], weights=weights)) for values in maps]


def _mean_map(maps: list[Map], looks: tuple[Look, ...]) -> Map:
    """Return the weighted mean of maps; 0 where no view looks."""
    total = np.sum([each.weight * values for values, each in zip(maps, looks, strict=True)], axis=0)
    weight = np.sum([each.weight for each in looks], axis=0)
    return np.asarray(total / np.maximum(weight, 1e-6), np.float32)


@cache
def _looks() -> tuple[tuple[Look, ...], tuple[Look, ...]]:
    narrow, wide = (
        tuple(look(rolled(_DOWN, float(np.radians(roll))), fov_deg) for roll in rolls)
        for fov_deg, rolls in ((90.0, _NARROW_ROLLS_DEG), (120.0, (0.0, 90.0)))
    )
    return narrow, wide


@checks_settings
def people(
    picture: Picture,
    *,
    passers_by: Annotated[bool, Setting("also find people at a distance, not only the operator")] = True,
    min_area_deg2: Annotated[float, Setting("minimum size of a person, in square degrees", ge=0)] = 20.0,
    margin_deg: Annotated[float, Setting("angle by which people are dilated", ge=0, le=20)] = 1.0,
) -> Mask:
    """Return the pixels that show people, and what they hold in front of them, in one upright panorama.

    Two networks look at overlapping views: one segments people, the other outlines what is in the middle of a view and
    says whether it is a person. What they agree on in several views, rolled and mirrored, is a person. Below the
    camera, where nobody is upright, they look straight down (`people_below`); elsewhere, along the horizon
    (`upright_people`).

    Args:
        picture: (H, W, 3) uint8 RGB, the full sphere, up to within some 20°.

    Returns:
        (h, w) bool, with `WIDTH` columns or those of a smaller picture.

    Raises:
        UsageError: if the picture is not such an array, or a setting is out of bounds.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or picture.shape[1] % 2:
        raise UsageError(f"a panorama is (H, W, 3) uint8 with even W, got {picture.shape} {picture.dtype}")
    seen = SeenPanorama(picture)
    found = people_below(seen, min_area_deg2)
    found = upright_people(seen, found, min_area_deg2=min_area_deg2, passers_by=passers_by)
    large = large_areas(_at_size(found.astype(np.float32), seen.size_hw) > 0.5, min_area_deg2)
    margin = round(margin_deg * len(large) / 180)
    return dilated(large, margin) if margin and large.any() else large


def person_at(seen: SeenPanorama, area: Mask, *, least: float) -> tuple[float, Mask]:
    """Return the mean probability of a person over an area, in views of its own, and the pixels of the person.

    `seen`: the panorama. `area`: (H, W) bool, not empty. `least`: if the first view gives less than half of this
    probability, the others are left out.

    Returns:
        The probability, 0 if it is too low, or unless a person is detected in one of the views; and (H, W) bool.
    """
    size_hw = area.shape[0], area.shape[1]
    reduced = np.asarray(cv2.resize(area.astype(np.float32), MAP_HW[::-1], interpolation=cv2.INTER_AREA) >= 0.5)
    if not reduced.any():
        return 0.0, np.zeros_like(area)
    rays, weights = ray_grid(MAP_HW)[reduced], pixel_weights(MAP_HW)[reduced]
    center = weights @ rays
    center /= np.linalg.norm(center)
    extent_deg = float(np.degrees(np.percentile(np.arccos(np.clip(rays @ center, -1, 1)), 95)))
    # An area is seen again in the middle of views of its own, this many times as wide.
    fov_deg = float(np.clip(2.4 * extent_deg, 40.0, 110.0))
    # There is no upright direction within this angle of the nadir, so people there are not seen as the networks know
    # them.
    if center[1] > np.cos(np.radians(15.0)):
        looks = [look(rolled(_DOWN, roll), fov_deg) for roll in np.radians([0, 90, 180, 270])]
    else:
        looks = [look(rolled(upright_rotation(center), np.radians(roll)), fov_deg) for roll in (-12.0, 12.0)]
    first = looks[0].on_map(seen.probability(looks[0]))
    if _mean_in(first, reduced) < least / 2 or not any(seen.middle(each)[0] >= 0.6 for each in looks):
        return 0.0, np.zeros_like(area)
    maps = [first, *(each.on_map(seen.probability(each)) for each in looks[1:])]
    maps += [each.on_map(seen.probability(each, mirrored=True)) for each in looks]
    mean = _at_size(np.asarray(np.mean(maps, axis=0), np.float32), size_hw)
    # The mean probability of the pixels of a person.
    return _mean_in(mean, area), mean > 0.6


def _mean_in(probability: Map, area: Mask) -> float:
    return float(np.average(probability[area], weights=pixel_weights(area.shape)[area]))


def _at_size(probability: Map, size_hw: tuple[int, int]) -> Map:
    return np.asarray(cv2.resize(probability, size_hw[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
