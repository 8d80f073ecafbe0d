"""Pinhole pictures of photographs, without the distortion of their lenses."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_ROWS_AT_ONCE = 64


def undistorted_photograph(
    picture: NDArray[np.uint8], *, focal_px: float, radial: float
) -> tuple[NDArray[np.uint8], float]:
    """Return the pinhole picture of the same size, and its focal length.

    The focal length is the shortest one with which every pixel of the result is inside the photograph. A pinhole
    picture of a camera without distortion is the photograph itself.

    `picture`: (H, W, 3) uint8 RGB by a SIMPLE_RADIAL camera; see `pano_mvs.scene.photographs.Photographs`. `focal_px`:
    its focal length. `radial`: coefficient of its distortion.
    """
    if radial == 0:
        return picture, focal_px
    half = np.array(picture.shape[1::-1]) / 2
    focal = _focal_px(half, focal_px, radial)
    x, y = (np.arange(side) + 0.5 - side / 2 for side in picture.shape[1::-1])
    straight = np.empty_like(picture)
    for start in range(0, len(y), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        factor = focal_px / focal * (1 + radial * (x**2 + y[rows, None] ** 2) / focal**2)
        at_x = (factor * x + half[0] - 0.5).astype(np.float32)
        at_y = (factor * y[rows, None] + half[1] - 0.5).astype(np.float32)
        straight[rows] = cv2.remap(picture, at_x, at_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return straight, focal


def _focal_px(half: NDArray[np.float64], focal_px: float, radial: float) -> float:
    """Return the focal length of the pinhole picture, by bisection: a longer one shows less."""
    diagonal = float(np.hypot(*half))
    # The distortion moves directions beyond a radius back towards the centre; this share of the radius is used.
    unfolded = diagonal * float(np.sqrt(3 * max(-radial, 0))) / 0.99
    low = max(0.5 * focal_px, unfolded)
    high = max(focal_px * (1 + max(radial, 0) * (diagonal / focal_px) ** 2), low)
    if _is_inside(half / low, half / focal_px, radial):
        return low
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (low, middle) if _is_inside(half / middle, half / focal_px, radial) else (middle, high)
    return high


def _is_inside(pinhole: NDArray[np.float64], photograph: NDArray[np.float64], radial: float) -> bool:
    """Return whether the photograph contains the whole border of a pinhole picture.

    The border reaches furthest out at the middle of its sides or in its corners, depending on the sign of the
    distortion.

    `pinhole`: (2) half the width and height of the pinhole picture, divided by its focal length. `photograph`: (2) the
    same of the photograph. `radial`: coefficient of the distortion.
    """
    extremes = pinhole * np.array([(1, 0), (0, 1), (1, 1)])
    seen = extremes * (1 + radial * (extremes**2).sum(axis=1, keepdims=True))
    return bool((seen <= photograph).all())
