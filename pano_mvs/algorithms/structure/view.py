"""What the search for planes reads of one view, and what it finds: planes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.supported import has_texture
from pano_mvs.algorithms.filters.uncertainty import UNCONFIRMED_UNCERTAINTY
from pano_mvs.core.arrays import FloatArray, Picture
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_solid_angle, ray_grid
from pano_mvs.geometry.positions import positions_in_padded
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

Value = TypeVar("Value", bound=np.generic)

STEP_RAD = np.radians(0.1)
"""Distance of the samples across a crease."""
HALF_DIFFERENCE = 4
"""Steps from a crease to the two colours that are compared."""
_PAD_PX = 4
LEAST_UNCERTAINTY = 0.002
"""Least relative standard deviation of the distance of a plane, and of a point in the fit of one."""
_ROWS = 256


AZIMUTHS = 360
"""Azimuths of an outline, from the z axis of the world towards its x axis."""


@dataclass(frozen=True, eq=False)
class PlaneView:
    """A view on a grid of 256 to 511 rows and twice as many columns, or of all pixels of smaller ones.

    `load`: returns the panorama, (H, W, 3) RGB at full resolution. `cam_from_world`: its pose. `rays`: (h, w, 3) unit
    rays in the world. `ranges`: (h, w), NaN is invalid. `confidence`: (h, w). `uncertainty`: (h, w) relative standard
    deviation of the ranges. `area`: (h, w) solid angle.
    """

    load: Callable[[], Picture]
    cam_from_world: Rigid3
    rays: FloatArray
    ranges: FloatArray
    confidence: NDArray[np.uint8]
    uncertainty: FloatArray
    area: FloatArray

    @cached_property
    def azimuth(self) -> NDArray[np.int64]:
        """The azimuth of an outline in which each pixel lies, (h, w)."""
        return azimuths_of(self.rays)


def azimuths_of(rays: FloatArray) -> NDArray[np.int64]:
    """Return the azimuth of an outline in which rays (..., 3) of the world lie."""
    azimuth = np.arctan2(rays[..., 0], rays[..., 2]) * AZIMUTHS / (2 * np.pi)
    return np.asarray(azimuth.round().astype(np.int64) % AZIMUTHS)


def grid_rows(height: int) -> int:
    """Return the number of rows of the grid of a panorama with this height: all, or some from 256 to 511."""
    return height // max(1, height // _ROWS)


def on_grid(pixels: NDArray[Value], rows: int) -> NDArray[Value]:
    """Return the pixels of the grid, (rows, 2 rows, ...), of a full sphere (H, W, ...)."""
    height, width = pixels.shape[:2]
    row = (2 * np.arange(rows) + 1) * height // (2 * rows)
    column = (2 * np.arange(2 * rows) + 1) * width // (4 * rows)
    return np.asarray(pixels[row[:, None], column])


def plane_view(range_map: RangeMap, load: Callable[[], Picture], cam_from_world: Rigid3) -> PlaneView:
    """Return what the search for planes reads of a view.

    `range_map`: (H, W), the full sphere. `load`: returns the panorama, (H, W, 3) RGB. `cam_from_world`: its pose.
    """
    size = range_map.range.shape[0], range_map.range.shape[1]
    rows = grid_rows(size[0])
    rays = on_grid(ray_grid(size), rows) @ cam_from_world.rotation
    confidence = on_grid(range_map.confidence, rows)
    confirmed = confidence >= CONSISTENT_CONFIDENCE[0]
    supposed = np.where(on_grid(has_texture(load()), rows), 0.003, 0.02)
    uncertainty = np.where(confirmed, supposed, UNCONFIRMED_UNCERTAINTY)
    if range_map.uncertainty is not None:
        known = on_grid(range_map.uncertainty, rows).astype(np.float64)
        uncertainty = np.where(np.isnan(known), uncertainty, known)
    area = np.broadcast_to(pixel_solid_angle((rows, 2 * rows))[:, None], (rows, 2 * rows))
    return PlaneView(
        load,
        cam_from_world,
        rays,
        on_grid(range_map.range, rows).astype(np.float64),
        confidence,
        uncertainty,
        area,
    )


def plane_ranges(rays: FloatArray, center: FloatArray, *, normal: FloatArray, offset: float) -> FloatArray:
    """Return the range along rays (..., 3) from a centre (3,) to n · X = offset; NaN where its front is not seen."""
    cosine = rays @ normal
    height = offset - center @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        # Planes at a more grazing angle than this cosine are not assigned to pixels.
        return np.asarray(np.where((cosine < -0.02) & (height < 0), height / cosine, np.nan))


@dataclass(frozen=True, eq=False)
class ScenePlane:
    """The plane n · X = offset.

    `normal`: (3,) unit normal n in the world, towards the side from which it was seen. `offset`: in scene units.
    `support`: solid angle of its points, summed over views. `uncertainty`: relative standard deviation of its distance
    from the cameras. `is_level`: whether the normal is vertical; else it is horizontal.
    """

    normal: NDArray[np.float64]
    offset: float
    support: float
    uncertainty: float
    is_level: bool

    @property
    def y(self) -> float:
        """The height of a level plane, as a y coordinate of the world."""
        return float(self.offset * self.normal[1])


def world_rays(azimuth: FloatArray, dip: FloatArray) -> FloatArray:
    """Return unit rays in the world for azimuths and angles below the horizon."""
    level = np.cos(dip)
    return np.stack(np.broadcast_arrays(np.sin(azimuth) * level, np.sin(dip), np.cos(azimuth) * level), axis=-1)


def blurred(picture: Picture) -> NDArray[np.float32]:
    """Return a panorama (H, W, 3) for `differences`: blurred a little, and padded."""
    return np.asarray(cv2.GaussianBlur(pad_panorama(picture, _PAD_PX).astype(np.float32), (0, 0), 0.7))


def differences(picture: NDArray[np.float32], rays_in_cam: FloatArray, *, axis: int) -> NDArray[np.float32]:
    """Return how colours change along an axis of rays, `STEP_RAD` apart; it is 2 `HALF_DIFFERENCE` entries shorter.

    `picture`: from `blurred`. A strong edge counts no more than one of 40 levels, and stays as sharp as it is.
    """
    size = picture.shape[0] - 2 * _PAD_PX, picture.shape[1] - 2 * _PAD_PX
    at = positions_in_padded(rays_in_cam, size, _PAD_PX)
    colors = np.moveaxis(cv2.remap(picture, at, None, cv2.INTER_LINEAR), axis, 0)
    changes = colors[2 * HALF_DIFFERENCE :] - colors[: -2 * HALF_DIFFERENCE]
    largest = np.abs(changes).max(axis=-1)
    around = cv2.dilate(largest.reshape(len(largest), -1), np.ones((4 * HALF_DIFFERENCE + 1, 1), np.uint8))
    # Changes by more than 40 levels count like those.
    changes /= np.maximum(around.reshape(largest.shape) / 40.0, 1.0)[..., None]
    return np.asarray(np.moveaxis(changes, 0, axis))
