"""Blocks of a walk, each in a world of its own, for tests of merging."""

from __future__ import annotations

import numpy as np

from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_quat_wxyz, rotation_from_rotvec


def walk(count: int, *, seed: int = 0, line: bool = False) -> dict[str, Rigid3]:
    """Return cam_from_world of cameras on a circle, or on a line, by name."""
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * np.arange(count) / count
    centers = np.stack([5 * np.sin(angles), 0.1 * rng.normal(size=count), 5 * np.cos(angles)], axis=1)
    if line:
        centers = np.stack([0.5 * np.arange(count), np.zeros(count), np.zeros(count)], axis=1)
    return {
        f"{idx:03d}.png": Rigid3.from_center(rotation_from_quat_wxyz(rng.normal(size=4)), center)
        for idx, center in enumerate(centers)
    }


def some_world(seed: int) -> Similarity3:
    """Return a similarity world_from_walk."""
    rng = np.random.default_rng([seed, 7])
    return Similarity3(
        float(np.exp(rng.normal(0, 0.7))), rotation_from_quat_wxyz(rng.normal(size=4)), rng.normal(0, 5, size=3)
    )


def block_of(cameras: dict[str, Rigid3], chosen: list[int], world: Similarity3) -> dict[str, Rigid3]:
    """Return the cameras at some positions of a walk in another world."""
    names = list(cameras)
    return {names[idx % len(names)]: world.move_camera(cameras[names[idx % len(names)]]) for idx in chosen}


def bent(cameras: dict[str, Rigid3], turn_deg: float, stretch: float) -> dict[str, Rigid3]:
    """Return cameras whose path bends and stretches steadily, as drift does."""
    moved: dict[str, Rigid3] = {}
    names = list(cameras)
    centers = np.array([camera.center for camera in cameras.values()])
    place = centers[0]
    for idx, name in enumerate(names):
        turn = rotation_from_rotvec((0.0, np.radians(turn_deg) * idx / len(names), 0.0))
        if idx:
            place = place + (1 + stretch * idx / len(names)) * turn @ (centers[idx] - centers[idx - 1])
        moved[name] = Rigid3.from_center(cameras[name].rotation @ turn.T, place)
    return moved
