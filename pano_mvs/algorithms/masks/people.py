"""Find people in a single panorama: the operator, and passers-by."""

from __future__ import annotations

from functools import cache
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import upright_rotation
from pano_mvs.algorithms.masks.areas import area_labels, dilated, pixel_weights
from pano_mvs.algorithms.masks.person_views import (
    COARSE_HW,
    FINE_HW,
    WIDTH,
    Look,
    SeenPanorama,
    look,
    mean_probability,
    rolled,
)
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import ray_grid

__all__ = ["WIDTH", "people", "person_at"]

Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
Map = NDArray[np.float32]

_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_SEED = 0.7
# A candidate that its own views do not confirm may be a person together with the floor: it is tried again in parts.
_GROWN = (0.4, 0.6, 0.8)
_SAME_AREA = 0.8
# Pixels of the coarse map around somebody below the camera that are not another candidate.
_AROUND_PX = 2
# A candidate is seen again in the middle of views of its own, this many times as wide.
_VIEW_OF_EXTENT = 2.4
_MIN_FOV_DEG, _MAX_FOV_DEG = 40.0, 110.0
_ROLLS_DEG = (-12.0, 12.0)
# There is no upright direction within this angle of the nadir, so people there are not seen as the networks know them.
_NADIR_DEG = 15.0
_MIN_AGREEMENT, _MIN_PRESENCE, _MIN_ONE_PRESENCE = 0.75, 0.6, 0.3
# The mean probability of the pixels of a person.
_BELONGS = 0.6
# Somebody below the camera lies within this angle of the nadir on average, and reaches to within the second. Beyond
# the third, it is somebody beside it, whose head is seen in upright views only.
_BELOW_DEG, _BELOW_FROM_DEG, _BESIDE_DEG = 45.0, 30.0, 52.0
_BELOW_FOVS_DEG = (110.0, 130.0)
# Two of eight views of a field of view may miss a person; chairs, floors and poufs fail in more.
_MAY_MISS, _MIN_LOW, _MIN_MEAN, _MIN_SEEN_BELOW = 2, 0.65, 0.7, 0.5
_UNANIMOUS = 0.8
# People stand on the ground: their heads are not much farther above the horizon than their feet are below it.
# Those beside the camera may be taller than it, and may be seen in part.
_MAX_HEAD_TO_FEET, _HEAD_ABOVE_DEG, _NEAR_DEG = 0.8, 4.0, -30.0
_SQUARE_DEG_OF_SPHERE = 4 * np.pi * np.degrees(1) ** 2


@checks_settings
def people(
    picture: Picture,
    *,
    passers_by: Annotated[bool, Setting("also find people at a distance, not only the operator")] = True,
    min_area_deg2: Annotated[float, Setting("minimum size of a person, in square degrees", ge=0)] = 20.0,
    margin_deg: Annotated[float, Setting("angle by which people are dilated", ge=0, le=20)] = 1.0,
) -> Mask:
    """Return the pixels that show people, and what they hold in front of them, in one upright panorama.

    A network that segments people in ordinary pictures looks at overlapping pinhole views.

    Below the camera, where nobody is upright, it looks in eight rotations, with two fields of view. A person who
    crouches there is found in nearly all of them, a chair or a carpet only in some. A second network, which detects
    people, has to confirm it in one of them.

    Further views look below the horizon and along it. A candidate is where their mean is high. It is seen again in the
    middle of views of its own, rolled and mirrored, and is kept if the network finds it in each of them and the second
    network confirms it. Floors and furniture, which the first network takes for people now and then, fail.

    Args:
        picture: (H, W, 3) uint8 RGB, the full sphere, up to within some 20°.
        passers_by: whether to look along the horizon, too; without it, only people who reach below −20° are found.
        min_area_deg2: minimum size of a person.
        margin_deg: angle by which people are dilated, to include their soft edges.

    Returns:
        (h, w) bool, with `WIDTH` columns or those of a smaller picture.

    Raises:
        UsageError: if the picture is not such an array, or a setting is out of bounds.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or picture.shape[1] % 2:
        raise UsageError(f"a panorama is (H, W, 3) uint8 with even W, got {picture.shape} {picture.dtype}")
    seen = SeenPanorama(picture)
    found = _below(seen, min_area_deg2)
    groups = _search_looks()[: None if passers_by else 1]
    means = [mean_probability((seen.probability(each), each) for each in looks) for looks in groups]
    around = _around(found)
    candidates = np.where(around, np.float32(0), np.max(means, axis=0))
    tried: list[Mask] = []
    accepted = np.zeros(COARSE_HW, np.bool_)
    for grown in _GROWN:
        for area in _areas(candidates, grown, min_area_deg2 / 2):
            if (accepted & area).any() or any(
                area.sum() > _SAME_AREA * other.sum() for other in tried if (area & other).any()
            ):
                continue
            person = _confirmed(seen, area, candidates)
            found |= person
            if person.any():
                accepted |= area
            else:
                tried.append(area)
    return _large_and_dilated(_at_size(found.astype(np.float32), seen.size_hw) > 0.5, min_area_deg2, margin_deg)


def person_at(picture: Picture, area: Mask) -> tuple[float, Mask]:
    """Return the mean probability of a person over an area, in views of its own, and the pixels of the person.

    Args:
        picture: (H, W, 3) uint8 RGB, the full sphere.
        area: (H, W) bool, not empty.

    Returns:
        The probability, 0 unless a person is detected in one of the views; and (H, W) bool.
    """
    seen, coarse = SeenPanorama(picture), _reduced_mask(area)
    if coarse.any():
        looks, _ = _views_of(coarse, FINE_HW)
        if any(seen.presence(each) >= _MIN_PRESENCE for each in looks):
            seen_again = [seen.probability(each, mirrored=True) for each in looks]
            mean = _at_size(np.asarray(np.mean(seen_again, axis=0), np.float32), (area.shape[0], area.shape[1]))
            return float(np.average(mean[area], weights=pixel_weights(area.shape)[area])), mean > _BELONGS
    return 0.0, np.zeros_like(area)


def _around(found: Mask) -> Mask:
    """Return the pixels, `COARSE_HW`, of people below the camera and around them; not of those who stand beside it."""
    pixels = _reduced_mask(found)
    if not pixels.any() or np.percentile(_off_nadir_deg()[pixels], 98) > _BESIDE_DEG:
        return np.zeros_like(pixels)
    return dilated(pixels, _AROUND_PX)


def _below(seen: SeenPanorama, min_area_deg2: float) -> Mask:
    """Return the pixels, `FINE_HW`, of people below the camera."""
    nobody = np.zeros(FINE_HW, np.bool_)
    maps = _seen_below(seen, min_area_deg2)
    areas = _areas_below(mean_probability(maps), min_area_deg2 / 2) if maps else []
    areas = [area for area in areas if _agree(maps, area)]
    if not areas or not any(seen.presence(each) >= _MIN_SEEN_BELOW for each in _looks_below()[0] + _looks_below()[1]):
        return nobody
    mean = _at_size(mean_probability(maps), FINE_HW)
    labels = area_labels(np.asarray(mean > _BELONGS))
    inside = _at_size(np.any(areas, axis=0).astype(np.float32), FINE_HW) > 0.5
    return np.isin(labels, np.unique(labels[inside & (labels >= 0)]))


def _seen_below(seen: SeenPanorama, min_area_deg2: float) -> list[tuple[Map, Look]]:
    """Return the probabilities of the views of the nadir; only some if these agree, none without a person."""
    narrow, wide = _looks_below()
    maps: list[tuple[Map, Look]] = []
    # The first half of the views is enough if it is unanimous.
    for looks in (narrow[::2], wide[::2], narrow[1::2], wide[1::2]):
        maps += [(seen.probability(each), each) for each in looks]
        areas = _areas_below(mean_probability(maps), min_area_deg2 / 2)
        if not areas:
            return []
        if len(maps) == len(narrow) and all(_agree(maps, area, unanimous=True) for area in areas):
            break
    return maps


def _areas_below(mean: Map, min_area_deg2: float) -> list[Mask]:
    """Return the candidates that lie below the camera."""
    off_nadir_deg, weights = _off_nadir_deg(), pixel_weights(COARSE_HW)
    return [
        area
        for area in _areas(mean, 0.5, min_area_deg2)
        if off_nadir_deg[area].min() < _BELOW_FROM_DEG
        and np.average(off_nadir_deg[area], weights=weights[area]) < _BELOW_DEG
    ]


def _agree(maps: list[tuple[Map, Look]], area: Mask, *, unanimous: bool = False) -> bool:
    """Return whether nearly all views of each field of view find a person in an area."""
    shares: dict[float, list[float]] = {}
    for probability, seen in maps:
        weights = pixel_weights(COARSE_HW)[area] * (seen.weight[area] + 1e-6)
        shares.setdefault(seen.view.focal_px, []).append(float(np.average(probability[area], weights=weights)))
    if unanimous:
        return min(map(min, shares.values())) >= _UNANIMOUS
    return all(
        sorted(found)[len(found) * _MAY_MISS // 8] >= _MIN_LOW and np.mean(found) >= _MIN_MEAN
        for found in shares.values()
    )


@cache
def _off_nadir_deg() -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(ray_grid(COARSE_HW)[..., 1], -1, 1))))


def _areas(candidates: Map, grown: float, min_area_deg2: float) -> list[Mask]:
    """Return the connected areas, (h, w) each, above a probability that contain a seed and are large enough."""
    labels, weights = area_labels(candidates > grown), pixel_weights(candidates.shape)
    min_weight = min_area_deg2 / _SQUARE_DEG_OF_SPHERE * weights.sum()
    areas = (labels == label for label in np.unique(labels[candidates > max(_SEED, grown)]))
    return [area for area in areas if weights[area].sum() >= min_weight]


def _confirmed(seen: SeenPanorama, area: Mask, candidates: Map) -> Mask:
    """Return the pixels of a person, `FINE_HW`, that its own views confirm; none if they do not."""
    nobody = np.zeros(FINE_HW, np.bool_)
    looks, upright = _views_of(area, FINE_HW)
    if upright and (not _may_stand(area) or not _present(seen, looks)):
        return nobody
    probable = _at_size(np.where(area, candidates, np.float32(0)), FINE_HW)
    core, weights = probable > _SEED, pixel_weights(FINE_HW)
    if not core.any():
        return nobody
    seen_again = []
    for each in looks:
        seen_again.append(seen.probability(each, mirrored=True))
        if np.average(seen_again[-1][core], weights=weights[core]) < _MIN_AGREEMENT:
            return nobody
    mean = np.mean([*seen_again, _at_size(candidates, FINE_HW)], axis=0, dtype=np.float32)
    labels = area_labels(np.asarray(mean > _BELONGS))
    return np.isin(labels, np.unique(labels[core & (labels >= 0)]))


def _may_stand(area: Mask) -> bool:
    """Return whether an area can be of somebody who stands on the ground, and is not a part of a facade."""
    rows = np.flatnonzero(area.any(axis=1))
    top_deg, bottom_deg = (90 - (row + 0.5) * 180 / len(area) for row in (rows[0], rows[-1]))
    return bool(bottom_deg < _NEAR_DEG or top_deg < _HEAD_ABOVE_DEG - _MAX_HEAD_TO_FEET * bottom_deg)


def _present(seen: SeenPanorama, looks: list[Look]) -> bool:
    """Return whether the second network sees a person in all views on average, also if they are mirrored."""
    found: list[float] = []
    for mirrored in (False, True):
        for each in looks:
            found.append(seen.presence(each, mirrored=mirrored))
            if found[-1] < _MIN_ONE_PRESENCE:
                return False
    return bool(np.mean(found) >= _MIN_PRESENCE)


def _large_and_dilated(found: Mask, min_area_deg2: float, margin_deg: float) -> Mask:
    if not found.any():
        return found
    labels, weights = area_labels(found), pixel_weights(found.shape)
    sizes = np.bincount(labels[found], weights[found], labels.size) / weights.sum() * _SQUARE_DEG_OF_SPHERE
    large = np.zeros_like(found)
    large[found] = sizes[labels[found]] >= min_area_deg2
    margin = round(margin_deg * len(found) / 180)
    return dilated(large, margin) if margin and large.any() else large


@cache
def _search_looks() -> tuple[tuple[Look, ...], ...]:
    """Return the groups of views in which people are looked for: below the horizon, along it."""
    below, along = np.radians(np.arange(0, 360, 45)), np.radians(np.arange(30, 390, 60))
    return (
        tuple(look(upright_rotation(_ray(azimuth, -45.0)), 90.0) for azimuth in below),
        tuple(look(upright_rotation(_ray(azimuth, -10.0)), 80.0) for azimuth in along),
    )


@cache
def _looks_below() -> tuple[tuple[Look, ...], ...]:
    """Return for each field of view the views of the nadir in eight rotations."""
    azimuths = np.radians(np.arange(0, 360, 45))
    return tuple(tuple(look(rolled(_DOWN, azimuth), fov) for azimuth in azimuths) for fov in _BELOW_FOVS_DEG)


def _views_of(area: Mask, map_hw: tuple[int, int]) -> tuple[list[Look], bool]:
    """Return views with a candidate in their middle, in several orientations, and whether they are upright."""
    rays, weights = ray_grid(COARSE_HW)[area], pixel_weights(COARSE_HW)[area]
    center = weights @ rays
    center /= np.linalg.norm(center)
    extent_deg = float(np.degrees(np.percentile(np.arccos(np.clip(rays @ center, -1, 1)), 95)))
    fov_deg = float(np.clip(_VIEW_OF_EXTENT * extent_deg, _MIN_FOV_DEG, _MAX_FOV_DEG))
    if center[1] > np.cos(np.radians(_NADIR_DEG)):
        return [look(rolled(_DOWN, roll), fov_deg, map_hw) for roll in np.radians([0, 90, 180, 270])], False
    upright = upright_rotation(center)
    return [look(rolled(upright, np.radians(roll)), fov_deg, map_hw) for roll in _ROLLS_DEG], True


def _ray(azimuth: float, elevation_deg: float) -> FloatArray:
    elevation = np.radians(elevation_deg)
    return np.array([np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])


def _reduced_mask(pixels: Mask) -> Mask:
    """Return a mask at `COARSE_HW`, True where most of a pixel is."""
    return np.asarray(cv2.resize(pixels.astype(np.float32), COARSE_HW[::-1], interpolation=cv2.INTER_AREA) >= 0.5)


def _at_size(probability: Map, size_hw: tuple[int, int]) -> Map:
    return np.asarray(cv2.resize(probability, size_hw[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
