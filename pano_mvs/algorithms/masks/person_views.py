"""Pinhole views of a panorama for the networks that find people, and their results as maps of directions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.learned.networks import packaged_network
from pano_mvs.algorithms.panoramas import reduced_panorama
from pano_mvs.core.arrays import FloatArray, Picture
from pano_mvs.geometry import PinholeView, pad_panorama, ray_grid, rotation_from_rotvec
from pano_mvs.geometry.positions import positions_in_padded

SIDE_PX = 256
"""Width and height of the pictures that the networks read."""

Map = NDArray[np.float32]

# By the digest, another file means another code, so that no result of the old one is taken from a cache.
_SEGMENTATION = ("selfie_segmentation.onnx", "f3cbe4522e152d8912dfac15684014e7d279aa8f47408395bdbc3bd6bf7dfe38")
_POSE = ("pose_landmark_lite.onnx", "c6a6cc5427f37cd40ecfdc1cc2e63f290850be779b2efb998dd22470776d4646")
_MODELS = Path(__file__).parent / "models"


def person_probability(picture: Picture) -> Map:
    """Return how likely each pixel shows a person, (256, 256) in [0, 1], of an upright picture of one person or none.

    The network was trained on people who fill a large part of an upright picture. On its own it also finds floors,
    tables and stairs; see `people`.

    `picture`: (256, 256, 3) uint8 RGB.
    """
    return packaged_network(_MODELS / _SEGMENTATION[0], _SEGMENTATION[1])(picture=picture)[0]


def person_in_middle(picture: Picture) -> tuple[float, Map]:
    """Return how likely an upright picture shows a person in its middle, and how likely each pixel is of what is there.

    The network for poses outlines a person there more exactly than `person_probability`; otherwise some object. The
    first number is the flag by which it says whether its landmarks mean anything.

    `picture`: (256, 256, 3) uint8 RGB.

    Returns:
        Both in [0, 1]; the second one is (256, 256).
    """
    presence, outline = packaged_network(_MODELS / _POSE[0], _POSE[1])(picture=picture)
    return float(presence[0]), outline


MAP_HW = (256, 512)
"""Size of maps of directions."""

WIDTH = 1024
"""Columns of the panorama in which people are looked for, and of the result; smaller ones are used as they are."""

_PAD_PX = 2


@dataclass(frozen=True, eq=False)
class StereographicView:
    """A square stereographic picture: unlike a pinhole view, it keeps the shape of what is far from its middle.

    `view_from_cam`: (3, 3) rotation, as of `PinholeView`. `focal_px`: pixels of a radian in the middle.
    """

    view_from_cam: FloatArray
    focal_px: float

    def rays(self) -> FloatArray:
        """Return the unit rays (256, 256, 3) of the pixels in the panorama's camera frame."""
        offsets = np.arange(SIDE_PX) + 0.5 - SIDE_PX / 2
        x, y = np.meshgrid(offsets, offsets)
        # With p on the plane, the ray is (4 p, 4 − |p|²) / (4 + |p|²), in units of the focal length.
        squared = (x**2 + y**2) / self.focal_px**2
        in_view = np.stack([4 * x / self.focal_px, 4 * y / self.focal_px, 4 - squared], axis=-1)
        return np.asarray(in_view / (4 + squared)[..., None] @ self.view_from_cam)

    def pixels_from_rays(self, rays_in_cam: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) in which unit rays (..., 3) arrive."""
        in_view = rays_in_cam @ self.view_from_cam.T
        scale = 2 * self.focal_px / np.maximum(1 + in_view[..., 2:], 1e-6)
        return np.asarray(in_view[..., :2] * scale + SIDE_PX / 2)


@dataclass(frozen=True, eq=False)
class Look:
    """A square view, and where its pixels and those of a map of directions lie in one another."""

    view: PinholeView | StereographicView  # its geometry

    @property
    def wide(self) -> bool:
        """Whether its pixels are larger than those of a panorama of `WIDTH` columns."""
        # Views at least this wide are sampled from a panorama of half the size, so that fine texture does not alias.
        return self.view.focal_px <= SIDE_PX / 2 / float(np.tan(np.radians(85.0) / 2))

    @cached_property
    def rays(self) -> FloatArray:
        """The rays (256, 256, 3) of its pixels in the panorama's camera frame."""
        return self.view.rays()

    @cached_property
    def from_sphere(self) -> Map:
        """The position (x, y) of each pixel in a panorama, (256, 256, 2), as shares of its width and height."""
        size_hw = (SIDE_PX, 2 * SIDE_PX)
        positions = positions_in_padded(self.rays, size_hw, 0) + np.float32(0.5)
        return np.asarray(positions / np.array(size_hw[::-1]), np.float32)

    @cached_property
    def pixels(self) -> Map:
        """The position (x, y), in OpenCV's pixels, of each direction of the map in the view."""
        pixels = np.nan_to_num(self.view.pixels_from_rays(_rays()), nan=-1e3).astype(np.float32)
        return pixels - np.float32(0.5)

    @cached_property
    def weight(self) -> Map:
        """The weight of each direction of the map: 1 in the middle of the view, 0 outside."""
        inside = np.minimum(self.pixels, SIDE_PX - 1 - self.pixels).min(axis=-1) + np.float32(0.5)
        # Towards the border of a view, where a person is cut off, its probabilities count less.
        return np.asarray(np.clip(inside / np.float32(40), 0, 1), np.float32)

    def on_map(self, tile: Map) -> Map:
        """Return the values (256, 256) of a view's pixels in the directions of the map; 0 outside of the view."""
        found = cv2.remap(tile, self.pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(found, np.float32)


class SeenPanorama:
    """A panorama at the sizes in which views are sampled from it."""

    def __init__(self, picture: Picture) -> None:
        """Take a panorama, (H, W, 3) uint8 RGB, and reduce it to `WIDTH` columns."""
        reduced = reduced_panorama(picture, WIDTH)
        self._full = pad_panorama(reduced, _PAD_PX)
        self._half = pad_panorama(reduced_panorama(reduced, WIDTH // 2), _PAD_PX)
        self.size_hw = (reduced.shape[0], reduced.shape[1])
        self._latest: tuple[Look, Picture] | None = None

    def image(self, look: Look, *, mirrored: bool = False) -> Picture:
        """Return the image of a view, (256, 256, 3) uint8 RGB; the latest is kept, since both networks look at it."""
        if self._latest is None or self._latest[0] is not look:
            padded = self._half if look.wide else self._full
            size_wh = np.array([padded.shape[1] - 2 * _PAD_PX, padded.shape[0] - 2 * _PAD_PX], np.float32)
            at = look.from_sphere * size_wh + np.float32(_PAD_PX - 0.5)
            self._latest = look, np.asarray(cv2.remap(padded, at, None, cv2.INTER_LINEAR), np.uint8)
        image = self._latest[1]
        return np.ascontiguousarray(image[:, ::-1]) if mirrored else image

    def probability(self, look: Look, *, mirrored: bool = False) -> Map:
        """Return the probability of a person in each pixel of a view, (256, 256)."""
        found = person_probability(self.image(look, mirrored=mirrored))
        return found[:, ::-1] if mirrored else found

    def middle(self, look: Look, *, mirrored: bool = False) -> tuple[float, Map]:
        """Return how likely a view shows a person in its middle, and its outline, as by `person_in_middle`."""
        presence, outline = person_in_middle(self.image(look, mirrored=mirrored))
        return presence, outline[:, ::-1] if mirrored else outline


def look(view_from_cam: FloatArray, fov_deg: float) -> Look:
    """Return a square pinhole view with a field of view."""
    focal_px = SIDE_PX / 2 / float(np.tan(np.radians(fov_deg) / 2))
    return Look(PinholeView(view_from_cam, focal_px, np.full(2, SIDE_PX / 2), (SIDE_PX, SIDE_PX)))


def stereographic_look(view_from_cam: FloatArray, fov_deg: float) -> Look:
    """Return a square stereographic view with a field of view."""
    return Look(StereographicView(view_from_cam, SIDE_PX / 4 / float(np.tan(np.radians(fov_deg) / 4))))


@cache
def _rays() -> FloatArray:
    return ray_grid(MAP_HW)


def rolled(view_from_cam: FloatArray, roll: float) -> FloatArray:
    """Return the rotation of a view that is rolled about its axis."""
    return np.asarray(rotation_from_rotvec(np.array([0.0, 0.0, roll])) @ view_from_cam)
