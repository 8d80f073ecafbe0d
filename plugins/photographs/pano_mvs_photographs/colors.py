"""The colours of photographs with known cameras for a cloud."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import check_settings, setting
from pano_mvs.scene import PointCloud
from pano_mvs_photographs.camera import PhotographCamera

_CELLS = 200
_MIN_POINTS = 200
_CORRELATED = (0.8, 0.95)


@dataclass(frozen=True, slots=True)
class PhotographColorSettings:
    """How photographs colour a cloud.

    A point keeps its colour where a photograph, after the correction of its exposure, differs by more than
    `max_difference` on the scale of the panoramas: something has moved, or stands in front of the point.
    """

    max_difference: float = setting(
        30.0, gt=0, le=255, doc="maximum difference of a photograph's coarse colour from the point's, in grey levels"
    )

    def __post_init__(self) -> None:
        """Raise UsageError if a setting is out of bounds."""
        check_settings(self)


class PhotographColors:
    """The colours of a cloud, to which photographs are added one after the other.

    `cloud`: the cloud. `settings`: how photographs colour it.
    """

    def __init__(self, cloud: PointCloud, settings: PhotographColorSettings) -> None:
        self._cloud = cloud
        self._settings = settings
        self._sums = np.zeros((len(cloud), 3))
        self._weights = np.zeros(len(cloud))
        self._shares = np.zeros(len(cloud))

    def add(self, photograph: NDArray[np.uint8], camera: PhotographCamera) -> int:
        """Add the colours that a photograph (H, W, 3) shows; return the number of points that it colours."""
        size_hw = (photograph.shape[0], photograph.shape[1])
        seen, pixels, weights = _visible(self._cloud, camera, size_hw)
        if len(seen) < _MIN_POINTS:
            return 0
        spacing_px = float(np.sqrt(np.prod(size_hw) / len(seen)))
        sharp = _sampled(photograph, pixels, size_hw, blur_px=0.5 * spacing_px)
        coarse = _sampled(photograph, pixels, size_hw, blur_px=2 * spacing_px)
        own = self._cloud.colors_rgb[seen].astype(np.float64)
        gains, contrasts = _exposure(coarse, own)
        corrected, compared = ((255 * gains * (colors / 255) ** contrasts).clip(0, 255) for colors in (sharp, coarse))
        alike = np.abs(compared - own).max(axis=1) < self._settings.max_difference
        seen, weights, corrected, pixels = seen[alike], weights[alike], corrected[alike], pixels[alike]
        self._sums[seen] += weights[:, None] * corrected
        self._weights[seen] += weights
        to_border = np.minimum(pixels, np.array(size_hw[::-1]) - pixels).min(axis=1) / min(size_hw)
        # Colours fade in over this share of the shorter side, so that no edge of a photograph is seen.
        self._shares[seen] = np.maximum(self._shares[seen], np.clip(to_border / 0.06, 0, 1))
        return len(seen)

    @property
    def colored(self) -> int:
        """The number of points that have a colour from a photograph."""
        return int((self._shares > 0).sum())

    def colors_rgb(self) -> NDArray[np.uint8]:
        """Return the colours of all points, (N, 3)."""
        own = self._cloud.colors_rgb.astype(np.float64)
        new = self._sums / np.maximum(self._weights, 1e-12)[:, None]
        mixed = own + self._shares[:, None] * (new - own)
        return np.where(self._shares[:, None] > 0, np.rint(mixed).clip(0, 255), own).astype(np.uint8)


def _visible(
    cloud: PointCloud, camera: PhotographCamera, size_hw: tuple[int, int]
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Return the points that a photograph sees: positions (M,), pixels (M, 2) and weights (M,), pixels per area.

    A point is hidden if the cloud, which is that of the panoramas' ranges, has a point well before it.
    """
    points = cloud.points_in_world.astype(np.float64)
    pixels, before = camera.project(points, size_hw)
    inside = np.flatnonzero(before & ((pixels >= 0) & (pixels < size_hw[::-1])).all(axis=1))
    if not len(inside):
        return inside, pixels[inside], np.zeros(0)
    pixels, view = pixels[inside], camera.cam_from_world.center - points[inside]
    distance = np.maximum(np.linalg.norm(view, axis=1), 1e-9)
    cell_px = max(size_hw) / _CELLS
    column, row = np.floor(pixels / cell_px).astype(np.intp).T
    nearest = np.full((_CELLS + 1, _CELLS + 1), np.inf, np.float32)
    np.minimum.at(nearest, (row, column), distance.astype(np.float32))
    nearest = np.asarray(cv2.erode(nearest, np.ones((3, 3), np.uint8)), np.float32)
    cosine = (cloud.normals_in_world[inside] * view).sum(axis=1) / distance
    # The nearest point of each cell and its neighbours hides points that are further away by more than this share.
    open_to = (distance <= (1 + 0.08) * nearest[row, column]) & (cosine > 0.15)
    weights = cosine * (camera.focal_px / distance) ** 2
    return inside[open_to], pixels[open_to], weights[open_to]


def _sampled(
    photograph: NDArray[np.uint8], pixels_px: FloatArray, size_hw: tuple[int, int], *, blur_px: float
) -> FloatArray:
    """Return the colours (M, 3) at pixels, averaged over about `blur_px`."""
    scale = min(1.0, 1 / max(blur_px, 1e-9))
    size_xy = [max(2, round(side * scale)) for side in size_hw[::-1]]
    reduced = cv2.resize(photograph, size_xy, interpolation=cv2.INTER_AREA) if scale < 1 else photograph
    at = pixels_px * (np.array(reduced.shape[1::-1]) / np.array(size_hw[::-1])) - 0.5
    row, column = (np.ascontiguousarray(values, np.float32) for values in (at[:, 1], at[:, 0]))
    # OpenCV's tables have at most 32767 rows.
    blocks = [
        cv2.remap(
            reduced,
            column[None, first : first + 32000],
            row[None, first : first + 32000],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )[0]
        for first in range(0, len(row), 32000)
    ]
    return np.concatenate(blocks).astype(np.float64)


def _exposure(colors: FloatArray, own: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return gains and contrasts (3,) with own ≈ 255 gain (color / 255)^contrast, by a robust fit of the logarithms."""
    # Darker or brighter values are clipped or noisy.
    usable = (np.minimum(colors, own).min(axis=1) > 8.0) & (np.maximum(colors, own).max(axis=1) < 247.0)
    gains, contrasts = np.ones(3), np.ones(3)
    if usable.sum() < _MIN_POINTS:
        return gains, contrasts
    x, y = np.log(colors[usable] / 255), np.log(own[usable] / 255)
    for channel in range(3):
        offset, contrasts[channel] = _robust_line(x[:, channel], y[:, channel])
        gains[channel] = np.clip(np.exp(offset), 0.3, 3.0)
    return gains, contrasts


def _robust_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the offset and the slope of a line through points (x, y).

    The slope is the ratio of the standard deviations where x and y are closely correlated, and 1 where they are not: a
    photograph with more detail than the cloud would otherwise appear to have too much contrast.
    """
    offset, slope = float(np.median(y - x)), 1.0
    for _ in range(8):
        weights = 1 / (1 + ((y - offset - slope * x) / 0.1) ** 2)
        middle_x, middle_y = np.average(x, weights=weights), np.average(y, weights=weights)
        spread_x = float(np.average((x - middle_x) ** 2, weights=weights)) + 1e-6
        spread_y = float(np.average((y - middle_y) ** 2, weights=weights)) + 1e-6
        together = float(np.average((x - middle_x) * (y - middle_y), weights=weights))
        trust = np.clip((together / np.sqrt(spread_x * spread_y) - _CORRELATED[0]) / np.ptp(_CORRELATED), 0, 1)
        slope = float(np.clip(1 + trust * (np.sqrt(spread_y / spread_x) - 1), 0.6, 1.6))
        offset = float(middle_y - slope * middle_x)
    return offset, slope
