"""Whether a capture is upside down, from what is usual above and below the horizon.

Light comes from above. Floors, furniture and the ground have more texture than ceilings and the sky. And people take
the panoramas of a capture at one height above a floor, so that sparse points lie in a sharper layer below the cameras
than above them. None of this holds everywhere: a black ceiling is darker than its floor, a painted one has more
texture. So each difference is bounded, and one model weighs them, whose coefficients `tools/benchmarks/poses/
upside_down.py` fits to captures that are upright.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.points.floor import floor_below
from pano_mvs.algorithms.poses.frame.vertical_lines import (
    SIDES,
    Picture,
    find_segments,
    orthogonal_directions,
    up_from_lines,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import UP, pixel_from_ray, ray_grid, rotation_from_two_vectors, sample_panorama
from pano_mvs.scene import Poses

_SIZE_HW = (256, 512)
# Pictures are compared between these elevations: beyond furniture, up to the tripod.
_BAND_DEG = (55.0, 80.0)
# Fitted: where each difference is bounded, and its weight in the log-odds.
_SCALES = np.array([0.33, 1.27, 1.38])
_WEIGHTS = np.array([3.5, -3.8, -3.0])
LEVEL_DEG = 20.0
"""Tilt up to which a panorama counts as level."""
# Of single panoramas: the share that is level, and of these the share whose axes do not include the vertical (1 of 47).
_LEVEL, _OUTSIDE = 0.9, 0.03
PRIOR_LOG_ODDS = float(np.log(0.01 / 0.99))
"""One capture in a hundred is taken to be upside down."""


def upside_down_probability(poses: Poses, pictures: Mapping[str, Picture], up: FloatArray) -> float:
    """Return how likely it is that a direction points down, in [0, 1].

    Args:
        poses: registered images and their sparse points.
        pictures: image name to a function that loads its panorama; one is in memory at a time.
        up: (3,) unit vector, the up direction in the world according to the cameras.
    """
    return 1 / (1 + float(np.exp(-_log_odds(differences_below(poses, pictures, up[None])[0]))))


def ups_of_picture(image: NDArray[np.uint8], valid: NDArray[np.bool_]) -> list[FloatArray]:
    """Return what may be the zenith (3,) in the camera frame of a single panorama, the most probable direction first.

    The lines in the picture determine three axes. If one is within 20° of the camera's own up direction, it is the
    vertical with a probability of 90 %; if not, that direction counts as one more axis. Brightness and texture
    distinguish the ends of the axes. Those that are less probable than 10 % are left out.

    Args:
        image: (H, W, 3) uint8 RGB, the full sphere.
        valid: (H, W) bool; masked (False) pixels do not count.
    """
    segments = find_segments({"": lambda: (image, valid)}, {"": np.eye(3)})
    lines = up_from_lines(segments.nearly_vertical(UP, groups=SIDES), UP)
    own = lines.up if lines else UP
    axes = orthogonal_directions(segments)
    turned = np.zeros((0, 3)) if axes is None else axes[np.abs(axes @ UP) < np.cos(np.radians(LEVEL_DEG))]
    ends = np.concatenate([[own, -own], turned, -turned])
    prior = np.full(len(ends), (1 - _LEVEL) / max(1, 2 * len(turned)))
    prior[:2] = _LEVEL * (_OUTSIDE if len(turned) == 3 else 1) * np.array([1, np.exp(PRIOR_LOG_ODDS)])
    small = _reduced(image, valid)
    chances = _chances(np.array([_in_picture(*small, end) for end in ends]), prior)
    return [ends[idx] for idx in np.argsort(-chances, kind="stable") if chances[idx] >= 0.1]


def most_probable_up(poses: Poses, pictures: Mapping[str, Picture], axes: FloatArray) -> tuple[FloatArray, float]:
    """Return which end of which axis is up, a unit vector (3,) in the world, and how likely it is, in [0, 1].

    Args:
        poses: registered images and their sparse points.
        pictures: image name to a function that loads its panorama; one is in memory at a time.
        axes: (K, 3) unit vectors, one of which is vertical.
    """
    ends = np.concatenate([axes, -axes])
    chances = _chances(differences_below(poses, pictures, ends), np.ones(len(ends)))
    best = int(np.argmax(chances))
    return ends[best], float(chances[best])


def _chances(differences: FloatArray, prior: FloatArray) -> FloatArray:
    """Return how likely each of several directions (K,) is up, by what is below each (K, 2 or 3) and its prior (K,)."""
    # The odds are those against the opposite direction: half of them is due to either.
    logs = np.log(prior) - np.array([_log_odds(one) - PRIOR_LOG_ODDS for one in differences]) / 2
    chances = np.exp(logs - logs.max())
    return np.asarray(chances / chances.sum())


def differences_below(poses: Poses, pictures: Mapping[str, Picture], ups: FloatArray) -> FloatArray:
    """Return how much brighter, richer in texture and more like a floor a place is below the cameras than above.

    The result is (K, 3). The first two are differences of mean logarithms over the directions 55–80° below and above
    the horizon of at most 24 evenly chosen panoramas, 0 without pictures; the third of the number of points in the
    sharpest level surface.

    Args:
        poses: as in `upside_down_probability`, as the other two.
        pictures: image name to a function that loads its panorama.
        ups: (K, 3) unit vectors that may be up.
    """
    names = [idx for idx, name in enumerate(poses.names) if name in pictures]
    chosen = np.unique(np.linspace(0, max(0, len(names) - 1), min(len(names), 24)).astype(int))
    seen = []
    for idx in chosen:
        small = _reduced(*pictures[poses.names[names[idx]]]())
        seen.append([_in_picture(*small, poses.rotations[names[idx]] @ up) for up in ups])
    pictured = np.mean(seen, axis=0) if seen else np.zeros((len(ups), 2))
    floors = [
        [floor_below(poses.points_in_world, poses.centers, towards).points for towards in (up, -up)] for up in ups
    ]
    return np.column_stack([pictured, np.log1p(floors) @ [1.0, -1.0]])


def _log_odds(differences: FloatArray) -> float:
    """Return the log-odds that a place is upside down, from the first two or all three of `differences_below`."""
    count = len(differences)
    return float(np.tanh(differences / _SCALES[:count]) @ _WEIGHTS[:count]) + PRIOR_LOG_ODDS


def _reduced(image: NDArray[np.uint8], valid: NDArray[np.bool_]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return a panorama and its valid pixels (255, others less) at the size at which directions are compared."""
    small = cv2.resize(image, _SIZE_HW[::-1], interpolation=cv2.INTER_AREA)
    mask = cv2.resize(valid.astype(np.uint8) * 255, _SIZE_HW[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), np.asarray(mask, np.uint8)


def _in_picture(small: NDArray[np.uint8], mask: NDArray[np.uint8], up_in_cam: FloatArray) -> FloatArray:
    """Return the differences of brightness and texture, (2,); 0 where too little is valid both below and above."""
    turn = rotation_from_two_vectors(up_in_cam, UP)
    rows, weights = _band()
    picture = np.dstack([small, mask])

    def strip(of_rows: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Return brightness, texture and what is valid in some rows, without the first and the last one."""
        pixels = pixel_from_ray(ray_grid(_SIZE_HW)[of_rows] @ turn, _SIZE_HW)
        level = np.rint(sample_panorama(picture, pixels))
        # Logarithms of noise in black and of grain in plain surfaces say nothing.
        brightness = np.log(level[..., :3].mean(axis=2) / 255 + 0.05)
        across = (np.roll(brightness, -1, axis=1) - np.roll(brightness, 1, axis=1))[1:-1] / weights
        texture = np.log(np.hypot(across, brightness[2:] - brightness[:-2]) + 0.01)
        return brightness[1:-1], texture, level[1:-1, :, 3] > 254

    *above, valid_above = strip(rows)
    *below, valid_below = strip(_SIZE_HW[0] - 1 - rows)
    own = weights * (valid_above & valid_below)
    # Share of the compared directions that must not be masked.
    if own.sum() < 0.1 * _SIZE_HW[1] * weights.sum():
        return np.zeros(2)
    return np.array([((low - high) * own).sum() / own.sum() for low, high in zip(below, above, strict=True)])


@cache
def _band() -> tuple[NDArray[np.intp], FloatArray]:
    """Return the rows above the horizon that are compared, and one more on either side, with the cosines of the former.

    The cosines of their elevations are (N, 1).
    """
    cosine = np.hypot(*np.moveaxis(ray_grid(_SIZE_HW)[: _SIZE_HW[0] // 2, 0, ::2], -1, 0))
    low, high = np.cos(np.radians(_BAND_DEG))
    inside = np.flatnonzero((cosine < low) & (cosine > high))
    return np.arange(inside[0] - 1, inside[-1] + 2), cosine[inside, None]
