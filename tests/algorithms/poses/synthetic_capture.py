"""Captures without pictures: points in a box seen by cameras, with noise and wrong matches."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Features, TwoView


def random_rotation(rng: np.random.Generator) -> FloatArray:
    """Any rotation, as likely as any other."""
    axis = rng.normal(size=4)
    w, v = axis[0], axis[1:]
    return rotation_from_rotvec(2 * np.arctan2(np.linalg.norm(v), w) * v / np.linalg.norm(v))


def points_in_box(rng: np.random.Generator, count: int) -> FloatArray:
    """Points on the walls of a room of 6 × 3 × 5 around the origin, and some inside."""
    half = np.array([3.0, 1.5, 2.5])
    points = rng.uniform(-1, 1, size=(count, 3))
    on_wall = rng.random(count) < 0.8
    axis = rng.integers(3, size=count)
    rows = np.flatnonzero(on_wall)
    points[rows, axis[rows]] = np.sign(points[rows, axis[rows]])
    points = points * half
    result: FloatArray = points[np.linalg.norm(points, axis=1) > 1.2]
    return result


def noisy_bearings(rng: np.random.Generator, pose: Rigid3, points: FloatArray, *, noise_deg: float) -> FloatArray:
    """Unit rays of a camera to points, each turned a little."""
    rays = pose.apply(points)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays += np.deg2rad(noise_deg) * rng.normal(size=rays.shape)
    result: FloatArray = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return result


def features_from_bearings(bearings: FloatArray) -> Features:
    count = len(bearings)
    return Features(
        bearings=bearings,
        descriptors=np.zeros((count, 4), np.float32),
        sizes_rad=np.full(count, 0.01, np.float32),
        scores=np.ones(count, np.float32),
        colors_rgb=np.full((count, 3), 128, np.uint8),
        metric="l2",
        size_hw=(512, 1024),
    )


def synthetic_features(
    rng: np.random.Generator, poses: dict[str, Rigid3], *, points: int = 500, noise_deg: float = 0.05
) -> dict[str, Features]:
    """Key point n of every image shows point n."""
    world = points_in_box(rng, points)
    return {
        name: features_from_bearings(noisy_bearings(rng, pose, world, noise_deg=noise_deg))
        for name, pose in poses.items()
    }


def synthetic_matches(
    rng: np.random.Generator, count: int, *, seen: float = 0.6, outliers: float = 0.3
) -> NDArray[np.int32]:
    """True matches n–n of a share of all key points, and wrong ones beside them."""
    chosen = rng.permutation(count)[: int(seen * count)]
    matches = np.stack([chosen, chosen], axis=1)
    wrong = rng.permutation(len(matches))[: int(outliers * len(matches))]
    matches[wrong, 1] = rng.permutation(matches[wrong, 1])
    return matches.astype(np.int32)


def synthetic_two_views(
    rng: np.random.Generator, features: dict[str, Features], *, outliers: float = 0.3
) -> dict[tuple[str, str], TwoView]:
    return {
        (a, b): verify_pair(
            features[a], features[b], synthetic_matches(rng, len(features[a]), outliers=outliers), rng=rng
        )
        for a, b in combinations(features, 2)
    }


def random_poses(rng: np.random.Generator, count: int) -> dict[str, Rigid3]:
    """Cameras within half a unit of the origin, turned at random, none near another."""
    centers: list[FloatArray] = []
    while len(centers) < count:
        center = rng.uniform(-0.6, 0.6, size=3)
        if all(np.linalg.norm(center - other) > 0.3 for other in centers):
            centers.append(center)
    return {f"{n}.jpg": Rigid3.from_center(random_rotation(rng), center) for n, center in enumerate(centers)}
