"""Pinhole views of a panorama for the networks that find people, and their results as maps of directions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.person_network import SIDE_PX, person_presence, person_probability
from pano_mvs.geometry import PinholeView, pad_panorama, pixel_from_ray, ray_grid, rotation_from_rotvec

Picture = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
Map = NDArray[np.float32]

COARSE_HW, FINE_HW = (128, 256), (256, 512)
"""Sizes of maps of directions."""

WIDTH = 1024
"""Columns of the panorama in which people are looked for, and of the result; smaller ones are used as they are."""

# Towards the border of a view, where a person is cut off, its probabilities count less.
_BORDER_PX = 40
_PAD_PX = 2
# Views at least this wide are sampled from a panorama of half the size, so that fine texture does not alias.
_WIDE_DEG = 85.0


@dataclass(frozen=True, eq=False)
class Look:
    """A square view, and where its pixels and those of a map of directions lie in one another.

    Attributes:
        view: the pinhole view.
        map_hw: size of the map of directions.
    """

    view: PinholeView
    map_hw: tuple[int, int]

    @property
    def wide(self) -> bool:
        """Whether its pixels are larger than those of a panorama of `WIDTH` columns."""
        return self.view.focal_px <= SIDE_PX / 2 / float(np.tan(np.radians(_WIDE_DEG) / 2))

    @cached_property
    def from_sphere(self) -> Map:
        """The position (x, y) of each pixel in a panorama, (256, 256, 2), as shares of its width and height."""
        size_hw = (SIDE_PX, 2 * SIDE_PX)
        return np.asarray(pixel_from_ray(self.view.rays(), size_hw) / size_hw[::-1], np.float32)

    @cached_property
    def pixels(self) -> tuple[Map, Map, Map]:
        """For each direction of the map, x and y in OpenCV's pixels, and a weight: 1 in the middle, 0 outside."""
        pixels = np.nan_to_num(self.view.pixels_from_rays(_rays(self.map_hw)), nan=-1e3).astype(np.float32)
        inside = np.minimum(pixels, SIDE_PX - pixels).min(axis=-1)
        weight = np.clip(inside / np.float32(_BORDER_PX), 0, 1)
        return pixels[..., 0] - np.float32(0.5), pixels[..., 1] - np.float32(0.5), weight

    @property
    def weight(self) -> Map:
        """The weight of each direction of the map, see `pixels`."""
        return self.pixels[2]


class SeenPanorama:
    """A panorama at the sizes in which views are sampled from it."""

    def __init__(self, picture: Picture) -> None:
        """Take a panorama, (H, W, 3) uint8 RGB, and reduce it to `WIDTH` columns."""
        self._full = pad_panorama(_reduced(picture, WIDTH), _PAD_PX)
        self._half = pad_panorama(_reduced(picture, WIDTH // 2), _PAD_PX)
        self.size_hw = (min(picture.shape[0], WIDTH // 2), min(picture.shape[1], WIDTH))

    def image(self, look: Look) -> Picture:
        """Return the image of a view, (256, 256, 3) uint8 RGB."""
        padded = self._half if look.wide else self._full
        size_wh = np.array([padded.shape[1] - 2 * _PAD_PX, padded.shape[0] - 2 * _PAD_PX], np.float32)
        at = look.from_sphere * size_wh + np.float32(_PAD_PX - 0.5)
        return np.asarray(cv2.remap(padded, at, None, cv2.INTER_LINEAR), np.uint8)

    def probability(self, look: Look, *, mirrored: bool = False) -> Map:
        """Return the probability of a person in each direction of a view's map; 0 outside of the view."""
        image = self.image(look)
        in_view = person_probability(image)
        if mirrored:
            in_view = (in_view + person_probability(np.ascontiguousarray(image[:, ::-1]))[:, ::-1]) / np.float32(2)
        found = cv2.remap(in_view, *look.pixels[:2], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(found, np.float32)

    def presence(self, look: Look, *, mirrored: bool = False) -> float:
        """Return how likely a view shows a person in its middle."""
        image = self.image(look)
        return person_presence(np.ascontiguousarray(image[:, ::-1]) if mirrored else image)


def look(view_from_cam: FloatArray, fov_deg: float, map_hw: tuple[int, int] = COARSE_HW) -> Look:
    """Return a square view with its maps.

    Args:
        view_from_cam: (3, 3).
        fov_deg: its field of view.
        map_hw: size of the map of directions.
    """
    focal_px = SIDE_PX / 2 / float(np.tan(np.radians(fov_deg) / 2))
    return Look(PinholeView(view_from_cam, focal_px, np.full(2, SIDE_PX / 2), (SIDE_PX, SIDE_PX)), map_hw)


@lru_cache(maxsize=2)
def _rays(map_hw: tuple[int, int]) -> FloatArray:
    return ray_grid(map_hw)


def rolled(view_from_cam: FloatArray, roll: float) -> FloatArray:
    """Return the rotation of a view that is rolled about its axis."""
    return np.asarray(rotation_from_rotvec(np.array([0.0, 0.0, roll])) @ view_from_cam)


def mean_probability(maps: Iterable[tuple[Map, Look]]) -> Map:
    """Return the weighted mean over views of the probability in each direction; 0 where no view looks."""
    total = weight = np.zeros(1, np.float32)
    for probability, seen in maps:
        total = total + seen.weight * probability
        weight = weight + seen.weight
    return np.asarray(total / np.maximum(weight, 1e-6), np.float32)


def _reduced(picture: Picture, width: int) -> Picture:
    if picture.shape[1] <= width:
        return picture
    return np.asarray(cv2.resize(picture, (width, width // 2), interpolation=cv2.INTER_AREA), np.uint8)
