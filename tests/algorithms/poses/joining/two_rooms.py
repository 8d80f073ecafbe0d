"""Two rooms of points that see each other through a door, with two cameras in each, and no pictures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Features, TwoView

CENTERS = {
    "a1": (-2.4, 0.0, 0.3),
    "a2": (-1.5, 0.05, -0.8),
    "b1": (2.3, 0.02, -0.4),
    "b2": (1.6, -0.03, 0.9),
}
NOISE_RAD = 3e-4


def room_poses(*, turned: bool = False) -> dict[str, Rigid3]:
    """Return cam_from_world of two cameras in either room, level with any heading, or turned in any way."""
    rng = np.random.default_rng(4)
    poses = {}
    for name, center in CENTERS.items():
        heading = (0.0, rng.uniform(-np.pi, np.pi), 0.0)
        turn = rng.uniform(-1.5, 1.5, 3) if turned else np.zeros(3)
        poses[name] = Rigid3.from_center(rotation_from_rotvec(turn) @ rotation_from_rotvec(heading), np.array(center))
    return poses


def room_features(
    poses: dict[str, Rigid3], *, door: int, own: int = 220, false: int = 0, door_seed: int = 7
) -> dict[str, Features]:
    """Return the key points of all cameras: those of the own room, and some of the other one seen through the door.

    Args:
        poses: cam_from_world by name.
        door: number of points of either room that the cameras of the other room see too.
        own: number of points of each room.
        false: number of key points that match in all images, although they show something else in each.
        door_seed: of the points behind the door and of the descriptors.
    """
    rng = np.random.default_rng(door_seed)
    points = np.concatenate([_room_points(rng, -2.0, own), _room_points(rng, 2.0, own)])
    through = np.concatenate([_door_points(rng, -3.0, door), _door_points(rng, 3.0, door)])
    descriptors = rng.integers(0, 120, (len(points) + len(through) + false, 64)).astype(np.float32)
    features = {}
    for name, pose in poses.items():
        mine = np.arange(own) + (0 if name[0] == "a" else own)
        seen = np.concatenate([mine, 2 * own + np.arange(len(through) + false)])
        elsewhere = rng.normal(size=(false, 3)) * (1.0, 0.3, 1.0)
        rays = pose.apply(np.concatenate([points, through, elsewhere + pose.center])[seen])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays += rng.normal(0, NOISE_RAD, rays.shape)
        features[name] = Features(
            bearings=rays / np.linalg.norm(rays, axis=1, keepdims=True),
            descriptors=descriptors[seen] + rng.integers(-4, 5, (len(seen), 64)).astype(np.float32),
            sizes_rad=np.full(len(seen), 0.02, np.float32),
            scores=np.linspace(1, 0.1, len(seen), dtype=np.float32),
            colors_rgb=np.full((len(seen), 3), 128, np.uint8),
            metric="l2",
            size_hw=(512, 1024),
        )
    return features


def with_points_of_pairs(
    features: dict[str, Features], poses: dict[str, Rigid3], pairs: Iterable[tuple[str, ...]], *, count: int
) -> dict[str, Features]:
    """Return features with `count` more points near the door for each of some sets of cameras, seen by no other one."""
    rng = np.random.default_rng(5)
    found = dict(features)
    for pair in pairs:
        points = np.concatenate([_door_points(rng, x, count // 2) for x in (-3.0, 3.0)])
        descriptors = rng.integers(0, 120, (count, 64)).astype(np.float32)
        for name in pair:
            rays = poses[name].apply(points)
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            rays += rng.normal(0, NOISE_RAD, rays.shape)
            added = {"bearings": rays / np.linalg.norm(rays, axis=1, keepdims=True), "descriptors": descriptors}
            own = found[name]
            arrays: dict[str, Any] = {
                key: np.concatenate([getattr(own, key), added.get(key, getattr(own, key)[:count])])
                for key in ("bearings", "descriptors", "sizes_rad", "scores", "colors_rgb")
            }
            found[name] = replace(own, **arrays)
    return found


def matched(features: dict[str, Features]) -> dict[tuple[str, str], TwoView]:
    """Return all pairs of the capture."""
    return {
        (a, b): verify_pair(
            features[a], features[b], match_features(features[a], features[b]), rng=np.random.default_rng(1)
        )
        for a, b in combinations(features, 2)
    }


def _room_points(rng: np.random.Generator, middle: float, count: int) -> FloatArray:
    points = rng.uniform(-1, 1, (count, 3))
    side = rng.integers(3, size=count)
    points[np.arange(count), side] = np.sign(points[np.arange(count), side])
    return np.asarray(points * (1.9, 1.3, 2.0) + (middle, 0, 0))


def _door_points(rng: np.random.Generator, x: float, count: int) -> FloatArray:
    points: FloatArray = rng.uniform(-1, 1, (count, 3)) * (0.8, 0.9, 0.5) + (x, 0.1, 0.0)
    return points
