"""Captures without pictures in a place with a tiled floor, of which some pairs take one tile for another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, TwoView
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings, points_in_box, random_poses
from tests.algorithms.two_view.test_two_view import rng_of

TILE = np.array([0.7, 0.0, 0.0])
_ROWS, _COLUMNS = 13, 17
_LATTICE = np.arange(_ROWS * _COLUMNS).reshape(_ROWS, _COLUMNS)


@dataclass(frozen=True)
class AliasedCapture:
    """Key points, verified pairs and true poses."""

    poses: dict[str, Rigid3]
    features: dict[str, Features]
    two_views: dict[tuple[str, str], TwoView]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.poses)

    def best_only(self) -> dict[tuple[str, str], TwoView]:
        """Return the pairs without their runner-ups."""
        return {pair: view.with_alternatives([]) for pair, view in self.two_views.items()}


def same_matches(count: int, start: int = 0) -> NDArray[np.int32]:
    """Key point n of the one image is key point n of the other."""
    return np.stack([np.arange(start, start + count)] * 2, axis=1).astype(np.int32)


def view_of(second_from_first: Rigid3, matches_idx: NDArray[np.int32]) -> TwoView:
    """Return a pair's geometry with given matches."""
    return TwoView(
        matches_idx=matches_idx,
        rotation=second_from_first.rotation,
        direction=second_from_first.translation / np.linalg.norm(second_from_first.translation),
        residuals_rad=np.zeros(len(matches_idx), np.float32),
        geometry="general",
        candidates=len(matches_idx),
        log10_false_alarms=-float(len(matches_idx)),
        direction_std_deg=0.1,
    )


def shifted_pose(pose: Rigid3, tiles: float) -> Rigid3:
    """Return where a camera would stand some tiles further."""
    return Rigid3.from_center(pose.rotation, pose.center + tiles * TILE)


def aliased_capture(
    name: str,
    *,
    false: Mapping[tuple[int, int], int],
    views: int = 6,
    unique: int = 70,
    poses: dict[str, Rigid3] | None = None,
    with_truth: bool = True,
) -> AliasedCapture:
    """Return a capture in which the best geometry of some pairs is false.

    Key points from `_LATTICE.size` on are points in the room, seen by all images. Those before are tiles. True
    geometries have both; a false one, which takes each tile for one further along, has all tiles and more matches.

    Args:
        name: what is drawn.
        false: pairs of positions (i, j), i < j, to the number of tiles by which j seems to be further than it is.
        views: number of images.
        unique: number of points in the room.
        poses: of the images, instead of random ones.
        with_truth: whether the true geometry of a false pair is its runner-up.
    """
    rng = rng_of(name)
    poses = poses or random_poses(rng, views)
    rows, columns = (np.arange(count) - count // 2 for count in (_ROWS, _COLUMNS))
    tiles = rows.repeat(_COLUMNS)[:, None] * [0.0, 0.0, 0.7] + np.tile(columns, _ROWS)[:, None] * TILE + [0.0, 1.3, 0.0]
    room = points_in_box(rng, 3 * unique)[:unique]
    world = np.concatenate([tiles, room])
    features = {
        one: features_from_bearings(noisy_bearings(rng, pose, world, noise_deg=0.02)) for one, pose in poses.items()
    }
    two_views = {}
    for (i, a), (j, b) in combinations(enumerate(poses), 2):
        shift = false.get((i, j), 0)
        inside = same_matches(unique, _LATTICE.size)
        if not shift:
            some = rng.permutation(_LATTICE.size)[:60]
            matches = np.concatenate([np.stack([some, some], axis=1).astype(np.int32), inside])
            two_views[a, b] = view_of(poses[b] @ poses[a].inverse(), matches)
            continue
        # Whoever stands k tiles further sees tile n where tile n − k would be.
        on, back = max(shift, 0), max(-shift, 0)
        taken = np.stack([_shifted(on, back), _shifted(back, on)], axis=1)
        view = view_of(shifted_pose(poses[b], shift) @ poses[a].inverse(), taken.astype(np.int32))
        truth = [view_of(poses[b] @ poses[a].inverse(), inside)]
        two_views[a, b] = view.with_alternatives(truth if with_truth else [])
    return AliasedCapture(poses, features, two_views)


def _shifted(front: int, back: int) -> NDArray[np.intp]:
    """Return the tiles without some columns at the front and at the back."""
    return _LATTICE[:, front : _COLUMNS - back].ravel()
