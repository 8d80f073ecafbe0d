"""Find people below the camera, where nobody is upright."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import area_labels, pixel_weights
from pano_mvs.algorithms.masks.person_views import MAP_HW, Look, Map, SeenPanorama, look, rolled
from pano_mvs.core.arrays import Mask
from pano_mvs.geometry import ray_grid

_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Fields of view, and the rotations of each.
_NARROW_DEG, _NARROW_ROLLS_DEG = 90.0, (0.0, 90.0, 180.0, 270.0)
_WIDE_DEG, _WIDE_ROLLS_DEG = 120.0, (0.0, 90.0)
# A person reaches to within this angle of the nadir.
_REACH_DEG = 30.0
_BELONGS = 0.5
# What the narrow views give for the pixels of a person: on average, and at least. Furniture fails in some rotation.
# What contains the nadir itself, such as a rig, may fail in one, but has to be outlined in all views.
_MIN_PROBABILITY, _MIN_ONE_PROBABILITY = 0.75, 0.5
_AT_NADIR_DEG, _MIN_PROBABILITY_AT_NADIR = 2.0, 0.6
# How much of a person all views outline: the narrow ones, all, all without anybody detected.
_MIN_NARROW_OUTLINE, _MIN_OUTLINE, _CERTAIN_OUTLINE = 0.65, 0.75, 0.85
# The wide views may fail if one of the views shows a person for certain.
_MIN_WIDE_PROBABILITY, _MIN_PRESENCE, _CERTAIN_PRESENCE = 0.6, 0.5, 0.9


def people_below(seen: SeenPanorama, min_area_deg2: float) -> Mask:
    """Return the pixels, `MAP_HW`, of people below the camera.

    Two networks look straight down, in several rotations and with two fields of view: one segments people, the other
    outlines what is in the middle. They have to agree on an area, and the second has to detect a person.
    """
    nobody = np.zeros(MAP_HW, np.bool_)
    narrow, wide = _looks()
    probable = [each.on_map(seen.probability(each)) for each in narrow]
    if not _areas(np.mean(probable, axis=0), min_area_deg2):
        return nobody
    outlined = [each.on_map(seen.outline(each)) for each in narrow]
    areas = _areas(_mean([*probable, *outlined], narrow * 2), min_area_deg2)
    if not any(_likely(probable, outlined, area, min_outline=_MIN_NARROW_OUTLINE) for area in areas):
        return nobody
    probable += [each.on_map(seen.probability(each)) for each in wide]
    outlined += [each.on_map(seen.outline(each)) for each in wide]
    areas = _areas(_mean([*probable, *outlined], (narrow + wide) * 2), min_area_deg2)
    areas = [area for area in areas if _likely(probable, outlined, area, min_outline=_MIN_OUTLINE)]
    if not areas:
        return nobody
    accepted = [area for area in areas if _accepted(seen, probable, outlined, area=area)]
    return np.logical_or.reduce(accepted) if accepted else nobody


def _likely(probable: list[Map], outlined: list[Map], area: Mask, *, min_outline: float) -> bool:
    """Return whether the networks find a person in an area, in the narrow views and in all views."""
    found = _means(probable[: len(_NARROW_ROLLS_DEG)], area)
    if np.mean(_means(outlined, area)) < min_outline:
        return False
    if _off_nadir_deg()[area].min() < _AT_NADIR_DEG and np.mean(found) >= _MIN_PROBABILITY_AT_NADIR:
        return True
    return bool(np.mean(found) >= _MIN_PROBABILITY and min(found) >= _MIN_ONE_PROBABILITY)


def _accepted(seen: SeenPanorama, probable: list[Map], outlined: list[Map], *, area: Mask) -> bool:
    """Return whether an area that is likely is a person, or what is fixed below the camera."""
    at_nadir = _off_nadir_deg()[area].min() < _AT_NADIR_DEG
    if at_nadir and np.mean(_means(outlined, area)) >= _CERTAIN_OUTLINE:
        return True
    wide_agree = np.mean(_means(probable[len(_NARROW_ROLLS_DEG) :], area)) >= _MIN_WIDE_PROBABILITY
    least = _MIN_PRESENCE if at_nadir or wide_agree else _CERTAIN_PRESENCE
    narrow, wide = _looks()
    return any(seen.presence(each) >= least for each in narrow + wide)


def _areas(mean: Map, min_area_deg2: float) -> list[Mask]:
    """Return the connected areas near the nadir that are probable and large enough."""
    labels, weights = area_labels(mean > _BELONGS), pixel_weights(MAP_HW)
    near = np.unique(labels[(_off_nadir_deg() < _REACH_DEG) & (labels >= 0)])
    least = min_area_deg2 / (4 * np.pi * np.degrees(1) ** 2) * weights.sum()
    areas = (labels == label for label in near)
    return [area for area in areas if weights[area].sum() >= least]


def _means(maps: list[Map], area: Mask) -> list[float]:
    """Return the mean of each map over what it shows of an area."""
    weights = pixel_weights(MAP_HW)[area]
    return [float(np.average(values[area], weights=weights)) for values in maps]


def _mean(maps: list[Map], looks: tuple[Look, ...]) -> Map:
    """Return the weighted mean of maps; 0 where no view looks."""
    total = np.sum([each.weight * values for values, each in zip(maps, looks, strict=True)], axis=0)
    weight = np.sum([each.weight for each in looks], axis=0)
    return np.asarray(total / np.maximum(weight, 1e-6), np.float32)


@cache
def _looks() -> tuple[tuple[Look, ...], tuple[Look, ...]]:
    narrow, wide = (
        tuple(look(rolled(_DOWN, float(np.radians(roll))), fov_deg) for roll in rolls)
        for fov_deg, rolls in ((_NARROW_DEG, _NARROW_ROLLS_DEG), (_WIDE_DEG, _WIDE_ROLLS_DEG))
    )
    return narrow, wide


@cache
def _off_nadir_deg() -> NDArray[np.float64]:
    return np.asarray(np.degrees(np.arccos(np.clip(ray_grid(MAP_HW)[..., 1], -1, 1))))
