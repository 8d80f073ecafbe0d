"""Small pictures of the synthetic room, rendered once for all tests that ask the images about their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import overload

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, TwoView
from pano_mvs.testing.room import capture_poses, default_room, range_along, render
from tests.algorithms.poses.aliased_capture import same_matches, view_of
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings

Vector = tuple[float, float, float]

SIZE_HW = (96, 192)
WHOLE = np.ones(SIZE_HW, np.bool_)


class RoomPictures(Sequence[NDArray[np.uint8]]):
    """Panoramas of the room that are rendered when they are first used, so that tests are collected quickly."""

    def __init__(self, poses: Sequence[Rigid3], size_hw: tuple[int, int]) -> None:
        self._poses = tuple(poses)
        self._size_hw = size_hw

    def __len__(self) -> int:
        return len(self._poses)

    @overload
    def __getitem__(self, idx: int) -> NDArray[np.uint8]: ...
    @overload
    def __getitem__(self, idx: slice) -> list[NDArray[np.uint8]]: ...
    def __getitem__(self, idx: int | slice) -> NDArray[np.uint8] | list[NDArray[np.uint8]]:
        if isinstance(idx, slice):
            return [_picture(pose, self._size_hw) for pose in self._poses[idx]]
        return _picture(self._poses[idx], self._size_hw)


@cache
def _picture(pose: Rigid3, size_hw: tuple[int, int]) -> NDArray[np.uint8]:
    return render(default_room(), pose, size_hw)[0]


@cache
def room_capture(size_hw: tuple[int, int] = SIZE_HW) -> tuple[tuple[Rigid3, ...], RoomPictures]:
    """Return five cameras about 0.6 apart and their panoramas."""
    poses = tuple(capture_poses(5, seed=1, spread=0.7))
    return poses, RoomPictures(poses, size_hw)


def moved(pose: Rigid3, by: Vector) -> Rigid3:
    """Return a camera whose centre is elsewhere."""
    return Rigid3.from_center(pose.rotation, pose.center + np.array(by))


def room_matches(
    feigned: Mapping[int, Vector] | None = None, *, false: int = 60
) -> tuple[dict[str, Features], dict[tuple[str, str], TwoView]]:
    """Return key points on what the cameras see, and the verified pairs of all of them.

    Args:
        feigned: images that most matches with the others place elsewhere, by so much; the truth is the runner-up.
        false: number of points that such matches have; the true ones have 60.
    """
    return matches_of(room_capture()[0], feigned, false=false)


def matches_of(
    poses: Sequence[Rigid3], feigned: Mapping[int, Vector] | None = None, *, false: int = 60
) -> tuple[dict[str, Features], dict[tuple[str, str], TwoView]]:
    """Return the same as `room_matches`, of other cameras in the room."""
    feigned = feigned or {}
    rng = np.random.default_rng(23)
    rays = rng.normal(size=(60, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = rays * range_along(default_room(), np.zeros(3), rays)[:, None]
    repeated = rng.uniform(-1, 1, size=(false, 3)) * (3.0, 0.0, 2.5) + (0.0, 1.3, 0.0)
    # After the true key points come repeated things, as each image sees them from where it seems to stand.
    features = {
        f"{idx}.png": features_from_bearings(
            np.concatenate(
                [
                    noisy_bearings(rng, pose, seen, noise_deg=0.05),
                    noisy_bearings(rng, moved(pose, feigned.get(idx, (0.0, 0.0, 0.0))), repeated, noise_deg=0.05),
                ]
            )
        )
        for idx, pose in enumerate(poses)
    }
    true = same_matches(len(seen))
    views = {}
    for (i, a), (j, b) in combinations(enumerate(features), 2):
        view = view_of(poses[j] @ poses[i].inverse(), true)
        shift = np.array(feigned.get(j, (0.0, 0.0, 0.0))) - feigned.get(i, (0.0, 0.0, 0.0))
        if np.any(shift != 0):
            there = Rigid3.from_center(poses[j].rotation, poses[j].center + shift)
            view = view_of(there @ poses[i].inverse(), same_matches(false, len(seen))).with_alternatives([view])
        views[a, b] = view
    return features, views
