"""Captures of any length without pictures: cameras along a corridor, with visibility, noise and wrong matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, TwoView
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings, random_rotation

STEP = 0.7  # between two cameras
SIGHT = 6.0  # farther points are not found
HALF_WIDTH, HALF_HEIGHT = 1.5, 1.25
NEAREST = 0.7
CODE_SIZE = 128


@dataclass(frozen=True, eq=False)
class PathCapture:
    """Cameras along a corridor that bends, what they see, and which key point shows which point of the world."""

    poses: dict[str, Rigid3]
    features: dict[str, Features]
    point_of_keypoint: dict[str, NDArray[np.intp]]

    @property
    def length(self) -> float:
        centers = np.array([pose.center for pose in self.poses.values()])
        return float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())


def path_capture(
    rng: np.random.Generator, count: int, *, keypoints: int = 300, noise_deg: float = 0.03, described: bool = False
) -> PathCapture:
    """Cameras 0.7 apart, each turned at random, that find about so many points of walls within 6; the path meanders."""
    along = STEP * np.arange(count, dtype=np.float64)
    centers = _path(along) + rng.normal(0, 0.05, (count, 3))
    points = _walls(rng, along[-1], density=3.0 * keypoints / (2 * SIGHT))
    names = [f"{n:04d}.jpg" for n in range(count)]
    codes = rng.normal(size=(len(points), CODE_SIZE)) if described else None
    poses, features, ids = {}, {}, {}
    for name, center in zip(names, centers, strict=True):
        pose = Rigid3.from_center(random_rotation(rng), center)
        away = np.linalg.norm(points - center, axis=1)
        seen = np.flatnonzero((away < SIGHT) & (away > NEAREST) & (rng.random(len(points)) < 0.5))
        found = features_from_bearings(noisy_bearings(rng, pose, points[seen], noise_deg=noise_deg))
        if codes is not None:
            found = _described(rng, found, codes[seen])
        poses[name], features[name], ids[name] = pose, found, seen
    return PathCapture(poses, features, ids)


def window_matches(
    rng: np.random.Generator, capture: PathCapture, first: str, second: str, *, wrong: float = 0.2
) -> NDArray[np.int32]:
    """The common points of two cameras, nine tenths of them, and wrong matches so that they are a share of all."""
    _, mine, theirs = np.intersect1d(
        capture.point_of_keypoint[first], capture.point_of_keypoint[second], assume_unique=True, return_indices=True
    )
    matches = np.stack([mine, theirs], axis=1)[rng.permutation(len(mine))[: int(0.9 * len(mine))]]
    spoilt = rng.random(len(matches)) < wrong
    matches[spoilt, 1] = rng.permutation(matches[spoilt, 1])
    return matches.astype(np.int32)


def path_two_views(
    rng: np.random.Generator, capture: PathCapture, *, window: int = 4, wrong: float = 0.2
) -> dict[tuple[str, str], TwoView]:
    """The verified pairs of cameras that are at most so many places apart."""
    names = list(capture.poses)
    return {
        (a, b): verify_pair(
            capture.features[a], capture.features[b], window_matches(rng, capture, a, b, wrong=wrong), rng=rng
        )
        for n, a in enumerate(names)
        for b in names[n + 1 : n + 1 + window]
    }


def _path(along: FloatArray) -> FloatArray:
    """A meandering line of unit speed, nearly."""
    return np.stack([along, 2.0 * np.sin(along / 8.0), np.zeros_like(along)], axis=1)


def _walls(rng: np.random.Generator, length: float, *, density: float) -> FloatArray:
    """Points on both walls, floor and ceiling, `density` of them per unit of length."""
    along = rng.uniform(-SIGHT, length + SIGHT, int(density * (length + 2 * SIGHT)))
    side = rng.integers(4, size=len(along))
    across, up = rng.uniform(-HALF_WIDTH, HALF_WIDTH, len(along)), rng.uniform(-HALF_HEIGHT, HALF_HEIGHT, len(along))
    across = np.where(side == 0, -HALF_WIDTH, np.where(side == 1, HALF_WIDTH, across))
    up = np.where(side == 2, -HALF_HEIGHT, np.where(side == 3, HALF_HEIGHT, up))
    points = _path(along)
    points[:, 1] += across
    points[:, 2] = up
    return points


def _described(rng: np.random.Generator, features: Features, codes: FloatArray) -> Features:
    noisy = codes + 0.3 * rng.normal(size=codes.shape)
    return Features(
        bearings=features.bearings,
        descriptors=np.rint(np.clip(50 + 40 * noisy, 0, 255)).astype(np.float32),
        sizes_rad=features.sizes_rad,
        scores=features.scores,
        colors_rgb=features.colors_rgb,
        metric="l2",
        size_hw=features.size_hw,
    )
