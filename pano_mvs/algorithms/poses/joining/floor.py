"""Lengths in camera heights, from the floor that two images see: a sweep of one level plane.

Between panoramas a few metres apart, hardly a key point is seen by three of them, so that nothing relates the length of
one pair to that of another. But the cameras of a tour stand on floors, at one height. Given the rotation and the
direction of a pair, and the vertical, each length moves the floor of one image over that of the other; at the true
length, given in heights of the camera, their pictures agree. The agreement of all pairs of a group is added up over its
camera height, because some see a table top, which looks like a floor under a lower camera.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import reduced_mask, reduced_panorama
from pano_mvs.algorithms.poses.frame.upside_down import up_of_picture
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray

Plane = NDArray[np.float32]

LENGTHS = np.geomspace(0.2, 5.0, 60)
"""Lengths of a translation that are compared, in heights of the camera."""
MIN_MARGIN = 0.1
"""A length must agree better than any other by this correlation. In an empty house of 32 panoramas, 23 of 28 such
lengths of right pairs were right within 20 %, and most others put the floor on a counter; of 15 wrong pairs, one had a
length."""

_WIDTH_PX = 512
_RADIUS, _FEET, _CELLS = 3.0, 0.3, 72  # the part of the floor that is compared, in heights; below it stands the tripod
_SMOOTH_CELLS, _MAX_CONTRAST = 3.0, 15.0
_MIN_COMMON = 0.03  # of the cells
_NEIGHBOURHOOD = 0.2  # lengths that differ by less, as a logarithm, are not rivals
_HEIGHTS = np.geomspace(0.02, 50.0, 400)
_PAIRS = 12


class Floors:
    """The floors that the images of a capture see.

    Args:
        load: returns a panorama and its mask by its position in the capture.
    """

    def __init__(self, load: Callable[[int], tuple[NDArray[np.uint8], NDArray[np.bool_]]]) -> None:
        self._load = load
        self._seen = lru_cache(maxsize=64)(self._view)
        self._known: dict[tuple[int, int, bytes], FloatArray] = {}
        ax = (np.arange(_CELLS) + 0.5) / _CELLS * 2 * _RADIUS - _RADIUS
        x, z = np.meshgrid(ax, ax)
        self._cells = np.stack([x, np.ones_like(x), z], axis=2)
        distance = np.hypot(x, z)
        self._inside = (distance > _FEET) & (distance < _RADIUS)

    def length(self, first: int, second: int, second_from_first: Rigid3) -> float:
        """Return the length of a pair's translation in camera heights; NaN if the floor does not determine it.

        Args:
            first: position of an image.
            second: position of another one.
            second_from_first: their relative pose, |t| = 1.
        """
        return _peak(LENGTHS, self._agreement(first, second, second_from_first))

    def camera_height(self, model: PlacedModel) -> float:
        """Return the height of the cameras of a model above the floor in its unit; NaN if it is not determined."""
        heaviest = sorted(
            model.chosen, key=lambda edge: (-model.pairs.geometries[edge][model.chosen[edge]].weight, edge)
        )
        total, count = np.zeros(len(_HEIGHTS)), 0
        for first, second in heaviest[:_PAIRS]:
            relative = model.cameras[second] @ model.cameras[first].inverse()
            length = float(np.linalg.norm(relative.translation))
            if length > 0:
                found = self._agreement(first, second, Rigid3(relative.rotation, relative.translation / length))
                heights = (length / LENGTHS)[::-1]
                total += np.interp(np.log(_HEIGHTS), np.log(heights), np.nan_to_num(found)[::-1], left=0, right=0)
                count += 1
        return _peak(_HEIGHTS, total / count) if count else float("nan")

    def _agreement(self, first: int, second: int, pose: Rigid3) -> FloatArray:
        """Return how well two floors agree at each of `LENGTHS`, −1 … 1; NaN where they hardly overlap."""
        key = first, second, np.round(np.concatenate([pose.rotation.ravel(), pose.translation]), 3).tobytes()
        if key not in self._known:
            found = self._compared(first, second, pose) + self._compared(second, first, pose.inverse())
            with np.errstate(invalid="ignore", divide="ignore"):
                self._known[key] = found[:, 0] / np.sqrt(found[:, 1] * found[:, 2])
        return self._known[key]

    def _compared(self, first: int, second: int, pose: Rigid3) -> FloatArray:
        """Return the products of the first image's floor with the second one's, with itself, and of that, (L, 3)."""
        grey, valid, level_from_cam = self._seen(first)
        other_grey, other_valid, _ = self._seen(second)
        floor = self._cells @ level_from_cam
        down = pose.rotation @ level_from_cam[1]
        own, seen = _sampled(grey, floor), self._inside & (_sampled(valid, floor) > 0.5)
        turned = floor @ pose.rotation.T
        products = np.full((len(LENGTHS), 3), np.nan)
        for idx, length in enumerate(LENGTHS):
            points = turned + length * pose.translation
            below = points @ down
            with np.errstate(invalid="ignore", divide="ignore"):
                distance = np.linalg.norm(points - below[..., None] * down, axis=2) / below
            common = seen & (below > _FEET) & (distance > _FEET) & (distance < _RADIUS)
            common &= _sampled(other_valid, points) > 0.5
            if common.sum() >= _MIN_COMMON * common.size:
                one, other = (_details(plane, common) for plane in (own, _sampled(other_grey, points)))
                products[idx] = (one * other).sum(), (one * one).sum(), (other * other).sum()
        return products

    def _view(self, image: int) -> tuple[Plane, Plane, FloatArray]:
        """Return a panorama in grey and its mask, both small and padded, and its axes: right, down and forward."""
        picture, mask = self._load(image)
        small = reduced_panorama(picture, _WIDTH_PX)
        down = -up_of_picture(picture, mask)
        forward = np.array([0.0, 0.0, 1.0]) - down[2] * down
        forward /= np.linalg.norm(forward)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
        valid = reduced_mask(mask, _WIDTH_PX).astype(np.float32)
        return pad_panorama(grey, 1), pad_panorama(valid, 1), np.stack([np.cross(down, forward), down, forward])


def _peak(values: FloatArray, agreement: FloatArray) -> float:
    """Return the value that agrees best; NaN if another one that is not near it agrees nearly as well."""
    known = np.nan_to_num(agreement, nan=-1.0)
    best = int(np.argmax(known))
    apart = np.abs(np.log(values / values[best])) > _NEIGHBOURHOOD
    return float(values[best]) if known[best] - max(0.0, known[apart].max()) >= MIN_MARGIN else float("nan")


def _details(plane: Plane, common: NDArray[np.bool_]) -> Plane:
    """Return a picture of the floor without its shading, 0 outside of the common cells."""
    weight = cv2.GaussianBlur(common.astype(np.float32), (0, 0), _SMOOTH_CELLS)
    shading = cv2.GaussianBlur(np.where(common, plane, np.float32(0)), (0, 0), _SMOOTH_CELLS) / np.maximum(weight, 1e-3)
    return np.clip(np.where(common, plane - shading, np.float32(0)), -_MAX_CONTRAST, _MAX_CONTRAST)


def _sampled(plane: Plane, points: FloatArray) -> Plane:
    """Return the values (R, C) of a panorama that is padded by a pixel where it shows points (R, C, 3)."""
    size_hw = plane.shape[0] - 2, plane.shape[1] - 2
    rays = points / np.linalg.norm(points, axis=2, keepdims=True)
    pixels = pixel_from_ray(rays.reshape(-1, 3), size_hw).reshape((*points.shape[:2], 2)).astype(np.float32)
    x, y = (np.ascontiguousarray(pixels[..., axis] + np.float32(0.5)) for axis in (0, 1))
    return np.asarray(cv2.remap(plane, x, y, cv2.INTER_LINEAR), np.float32)
