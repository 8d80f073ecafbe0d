"""How far an image shows what it should show at a pose, by the ranges and colours that other cameras know."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, nearest_cameras
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, pixel_from_ray, pixel_solid_angle, ray_grid

_WINDOW = 7  # side of the windows, in small pixels, in which pictures are compared
_NOISE_VARIANCE = 12.0  # of a colour in Lab, all channels together
_MAX_CAMERAS = 256  # whose points are kept, of a MB each
_LEAST_KNOWN = 0.3  # share of a window for which colours are expected


class Appearance(NamedTuple):
    """What an image shows at a pose, compared with what is expected there."""

    agreement: float = 0.0  # mean correlation in small windows, from -1 to 1; 0 if nothing is expected
    correlation: float = 0.0  # of all colours, likewise
    cover: float = 0.0  # share of its textured pixels, by solid angle, for which something is expected
    unlike: float = 0.0  # share of these, by solid angle, whose window has a correlation below 0


class Surroundings:
    """What the cameras of a model know of their surroundings: points with colours.

    Seen from the pose of another image they say, without a sweep of it, what it should show there. Unlike ranges that
    are confirmed, this also counts what contradicts the pose.

    Args:
        confirmation: of the capture, whose small pictures are compared.
        cameras: cam_from_world by position of the image.
        ranges: returns the (H, W) ranges of a camera that other images confirm (`Confirmation.ranges`), NaN elsewhere;
            None if nothing is known of it.
    """

    def __init__(
        self,
        confirmation: Confirmation,
        cameras: Mapping[int, Rigid3],
        ranges: Callable[[int], NDArray[np.float32] | None],
    ) -> None:
        self._confirmation, self._cameras, self._ranges = confirmation, cameras, ranges
        self._known: dict[int, tuple[FloatArray, NDArray[np.float32]]] = {}

    def appearance(self, image: int, pose: Rigid3) -> Appearance:
        """Return how far an image shows at a pose (cam_from_world) what the nearest cameras know.

        Nearer points hide farther ones. What is expected is compared with what the image shows in windows, by their
        normalised correlation, and as a whole.
        """
        small = self._confirmation.small(image)
        sources = [self._points(idx) for idx in nearest_cameras(pose, self._cameras)]
        points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in sources)])
        colors = np.concatenate([np.zeros((0, 3), np.float32), *(colors for _, colors in sources)])
        if not len(points):
            return Appearance()
        expected, known = _seen(pose, points, colors, shape=small.mask.shape)
        known &= small.mask
        shown = self._confirmation.colors_lab(image)
        area = np.broadcast_to(pixel_solid_angle(known.shape)[:, None], known.shape)
        textured = small.textured & small.mask
        agreement, inside = _window_correlations(expected, shown, known)
        inside &= textured
        least = 0.3  # solid angle below which it counts as if there were this much, without correlation
        return Appearance(
            float((area * agreement)[inside].sum() / max(area[inside].sum(), least)),
            _correlation(expected[known], shown[known], area[known]),
            float(area[inside].sum() / max(area[textured].sum(), least)),
            float(area[inside & (agreement < 0)].sum() / max(area[inside].sum(), least)),
        )

    def _points(self, image: int) -> tuple[FloatArray, NDArray[np.float32]]:
        if image not in self._known:
            if len(self._known) >= _MAX_CAMERAS:
                del self._known[next(iter(self._known))]
            self._known[image] = self._points_of(image)
        return self._known[image]

    def _points_of(self, image: int) -> tuple[FloatArray, NDArray[np.float32]]:
        """Return the points that a camera knows, (P, 3), with their colours."""
        ranges = self._ranges(image)
        if ranges is None:
            return np.zeros((0, 3)), np.zeros((0, 3), np.float32)
        known = np.isfinite(ranges)
        camera = self._cameras[image]
        points = camera.center + ranges[known, None] * (ray_grid(ranges.shape)[known] @ camera.rotation)
        return points, self._confirmation.colors_lab(image)[known]


def _seen(
    pose: Rigid3, points: FloatArray, colors: NDArray[np.float32], *, shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the colours of points (P, 3) that a camera at a pose sees, (H, W, 3), and where it sees any."""
    height, width = shape
    in_camera = pose.apply(points)
    distances = np.linalg.norm(in_camera, axis=1)
    ahead = np.flatnonzero(distances > 0)
    columns, rows = np.floor(pixel_from_ray(in_camera[ahead], (height, width))).astype(int).T
    places = rows.clip(0, height - 1) * width + columns % width
    # Positive floats are ordered as their bits are, so that the least key of a pixel is that of its nearest point.
    keys = distances[ahead].astype(np.float32).view(np.uint32).astype(np.uint64) << 32 | ahead.astype(np.uint64)
    nearest = np.full(height * width, np.iinfo(np.uint64).max)
    np.minimum.at(nearest, places, keys)
    known = nearest < np.iinfo(np.uint64).max
    seen = np.zeros((height * width, 3), np.float32)
    seen[known] = colors[(nearest[known] & 0xFFFFFFFF).astype(np.intp)]
    return seen.reshape(height, width, 3), known.reshape(height, width)


def _window_correlations(
    first: NDArray[np.float32], second: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the correlation of two pictures in the window around each pixel, (H, W), and where enough is known."""
    weight = known.astype(np.float32)
    share = _mean(weight)
    per = np.maximum(share, 1e-3)[..., None]
    one, other = (_mean(picture * weight[..., None]) / per for picture in (first, second))
    squared, others_squared, product = (
        (_mean(a * b * weight[..., None]) / per - c * d).sum(axis=-1)
        for a, b, c, d in (
            (first, first, one, one), (second, second, other, other), (first, second, one, other)
        )
    )  # fmt: skip
    spread = (squared.clip(0) + _NOISE_VARIANCE) * (others_squared.clip(0) + _NOISE_VARIANCE)
    return product / np.sqrt(spread), known & (share > _LEAST_KNOWN)


def _mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.boxFilter(values, -1, (_WINDOW, _WINDOW), borderType=cv2.BORDER_REFLECT), np.float32)


def _correlation(first: NDArray[np.float32], second: NDArray[np.float32], area: FloatArray) -> float:
    """Return the correlation of colours (P, 3) with solid angles (P,); 0 without any."""
    if not len(area):
        return 0.0
    one, other = (values - np.average(values, axis=0, weights=area) for values in (first, second))
    weight = area[:, None]
    spread = (weight * one**2).sum() * (weight * other**2).sum()
    return float((weight * one * other).sum() / np.sqrt(spread)) if spread > 0 else 0.0
