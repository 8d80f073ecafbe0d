"""Find people in a single panorama: the operator, and passers-by."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import upright_rotation
from pano_mvs.algorithms.faces.pictures import face_image
from pano_mvs.algorithms.masks.areas import area_labels, dilated, pixel_weights
from pano_mvs.algorithms.masks.person_network import SIDE_PX, person_presence, person_probability
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import PinholeView, ray_grid, rotation_from_rotvec

Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
Map = NDArray[np.float32]

_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

WIDTH = 1024
"""Columns of the panorama in which people are looked for, and of the result; smaller ones are used as they are."""

# Candidates are looked for at this size.
_SEARCH_HW = (128, 256)
_SEED = 0.7
# A candidate that its own views do not confirm may be a person together with the floor: it is tried again in parts.
_GROWN = (0.4, 0.6, 0.8)
# Towards the border of a view, where a person is cut off, its probabilities count less.
_BORDER_PX = 40
# A candidate is seen again in the middle of views of its own, this many times as wide.
_VIEW_OF_EXTENT = 2.4
_MIN_FOV_DEG, _MAX_FOV_DEG = 40.0, 110.0
_ROLLS_DEG = (-12.0, 12.0)
# There is no upright direction within this angle of the nadir, so people there are not seen as the networks know them.
_NADIR_DEG = 15.0
_MIN_AGREEMENT, _MIN_PRESENCE = 0.75, 0.6
# The mean probability of the pixels of a person.
_BELONGS = 0.6
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

    A network that segments people in ordinary pictures looks at overlapping pinhole views around the nadir, below the
    horizon and along it, eight of each. A candidate is where their mean is high. It is seen again in the middle of
    views of its own, rolled and mirrored, and is kept if the network finds it in each of them and a second network,
    which detects people, confirms it. Floors and furniture, which the first network takes for people now and
    then, fail. Around the nadir, where nobody is upright, four rotations have to agree; a rig or a tripod's head is
    found there as well.

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
    small = _reduced(picture)
    candidates = _search(small, passers_by=passers_by)
    found = np.zeros(small.shape[:2], np.bool_)
    accepted = np.zeros(_SEARCH_HW, np.bool_)
    for grown in _GROWN:
        for area in _areas(candidates, grown, min_area_deg2 / 2):
            if not (accepted & area).any() and (person := _confirmed(small, area, candidates)).any():
                found |= person
                accepted |= area
    return _large_and_dilated(found, min_area_deg2=min_area_deg2, margin_deg=margin_deg)


def _reduced(picture: Picture) -> Picture:
    if picture.shape[1] <= WIDTH:
        return picture
    return np.asarray(cv2.resize(picture, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_AREA), np.uint8)


def _search(picture: Picture, *, passers_by: bool) -> Map:
    """Return the probability of a person in each direction, `_SEARCH_HW`: the largest mean of a group of views."""
    groups = _search_looks()[: None if passers_by else 2]
    return np.asarray(np.max([_mean_probability(picture, looks) for looks in groups], axis=0))


def _areas(candidates: Map, grown: float, min_area_deg2: float) -> list[Mask]:
    """Return the connected areas, (h, w) each, above a probability that contain a seed and are large enough."""
    labels, weights = area_labels(candidates > grown), pixel_weights(candidates.shape)
    min_weight = min_area_deg2 / _SQUARE_DEG_OF_SPHERE * weights.sum()
    areas = (labels == label for label in np.unique(labels[candidates > max(_SEED, grown)]))
    return [area for area in areas if weights[area].sum() >= min_weight]


def _confirmed(picture: Picture, area: Mask, candidates: Map) -> Mask:
    """Return the pixels of a person, at the picture's size, that its own views confirm; none if they do not."""
    size_hw = (picture.shape[0], picture.shape[1])
    probable = _at_size(np.where(area, candidates, np.float32(0)), size_hw)
    core, weights = probable > _SEED, pixel_weights(size_hw)
    nobody = np.zeros(size_hw, np.bool_)
    if not core.any():
        return nobody
    views, upright = _views_of(area)
    if upright and np.mean([person_presence(face_image(picture, view)) for view in views]) < _MIN_PRESENCE:
        return nobody
    seen_again = []
    for view in views:
        look = _look(view, size_hw)
        seen_again.append(_probability(picture, look, mirrored=True)[0])
        if np.average(seen_again[-1][core], weights=weights[core]) < _MIN_AGREEMENT:
            return nobody
    mean = np.mean([*seen_again, _at_size(candidates, size_hw)], axis=0, dtype=np.float32)
    labels = area_labels(np.asarray(mean > _BELONGS))
    return np.isin(labels, np.unique(labels[core & (labels >= 0)]))


def _large_and_dilated(found: Mask, *, min_area_deg2: float, margin_deg: float) -> Mask:
    if not found.any():
        return found
    labels, weights = area_labels(found), pixel_weights(found.shape)
    sizes = np.bincount(labels[found], weights[found], labels.size) / weights.sum() * _SQUARE_DEG_OF_SPHERE
    large = np.zeros_like(found)
    large[found] = sizes[labels[found]] >= min_area_deg2
    margin = round(margin_deg * len(found) / 180)
    return dilated(large, margin) if margin and large.any() else large


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """A view, and where its pixels and those of a map of directions lie in one another.

    Attributes:
        view: the pinhole view.
        x_px, y_px: (h, w) float32, the pixel of the view for each direction of the map, in OpenCV's pixels.
        weight: (h, w) float32, 1 in the middle of the view, 0 outside of it.
    """

    view: PinholeView
    x_px: Map
    y_px: Map
    weight: Map


@cache
def _search_looks() -> tuple[tuple[_Look, ...], ...]:
    """Return the groups of views in which people are looked for: at the nadir, below the horizon, along it."""
    azimuths = np.radians(np.arange(0, 360, 45))
    groups = (
        [_view(_rolled(_DOWN, azimuth), 100.0) for azimuth in azimuths],
        [_view(upright_rotation(_ray(azimuth, -45.0)), 90.0) for azimuth in azimuths],
        [_view(upright_rotation(_ray(azimuth, -10.0)), 70.0) for azimuth in azimuths],
    )
    return tuple(tuple(_look(view, _SEARCH_HW) for view in views) for views in groups)


def _look(view: PinholeView, map_hw: tuple[int, int]) -> _Look:
    pixels = np.nan_to_num(view.pixels_from_rays(ray_grid(map_hw)), nan=-1e3).astype(np.float32)
    inside = np.minimum(pixels, SIDE_PX - pixels).min(axis=-1)
    weight = np.clip(inside / np.float32(_BORDER_PX), 0, 1)
    return _Look(view, pixels[..., 0] - np.float32(0.5), pixels[..., 1] - np.float32(0.5), weight)


def _views_of(area: Mask) -> tuple[list[PinholeView], bool]:
    """Return views with a candidate in their middle, in several orientations, and whether they are upright."""
    rays, weights = ray_grid(_SEARCH_HW)[area], pixel_weights(_SEARCH_HW)[area]
    center = weights @ rays
    center /= np.linalg.norm(center)
    extent_deg = float(np.degrees(np.percentile(np.arccos(np.clip(rays @ center, -1, 1)), 95)))
    fov_deg = float(np.clip(_VIEW_OF_EXTENT * extent_deg, _MIN_FOV_DEG, _MAX_FOV_DEG))
    if center[1] > np.cos(np.radians(_NADIR_DEG)):
        return [_view(_rolled(_DOWN, roll), fov_deg) for roll in np.radians([0, 90, 180, 270])], False
    upright = upright_rotation(center)
    return [_view(_rolled(upright, np.radians(roll)), fov_deg) for roll in _ROLLS_DEG], True


def _view(view_from_cam: FloatArray, fov_deg: float) -> PinholeView:
    focal_px = SIDE_PX / 2 / float(np.tan(np.radians(fov_deg) / 2))
    return PinholeView(view_from_cam, focal_px, np.full(2, SIDE_PX / 2), (SIDE_PX, SIDE_PX))


def _rolled(view_from_cam: FloatArray, roll: float) -> FloatArray:
    return np.asarray(rotation_from_rotvec(np.array([0.0, 0.0, roll])) @ view_from_cam)


def _ray(azimuth: float, elevation_deg: float) -> FloatArray:
    elevation = np.radians(elevation_deg)
    return np.array([np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])


def _mean_probability(picture: Picture, looks: Iterable[_Look]) -> Map:
    """Return the weighted mean over views of the probability in each direction; 0 where no view looks."""
    total, weight = np.zeros(_SEARCH_HW, np.float32), np.zeros(_SEARCH_HW, np.float32)
    for look in looks:
        probability, share = _probability(picture, look)
        total += share * probability
        weight += share
    return np.asarray(total / np.maximum(weight, 1e-6))


def _probability(picture: Picture, look: _Look, *, mirrored: bool = False) -> tuple[Map, Map]:
    """Return the probability of a person in each direction, and its weight; both are 0 outside of the view."""
    image = face_image(picture, look.view)
    in_view = person_probability(image)
    if mirrored:
        in_view = (in_view + person_probability(np.ascontiguousarray(image[:, ::-1]))[:, ::-1]) / np.float32(2)
    found = cv2.remap(in_view, look.x_px, look.y_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(found, np.float32), look.weight


def _at_size(probability: Map, size_hw: tuple[int, int]) -> Map:
    return np.asarray(cv2.resize(probability, size_hw[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
