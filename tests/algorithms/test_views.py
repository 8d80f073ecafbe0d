"""Which pictures each reference is swept against."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from pano_mvs.algorithms.views import select_views
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Poses


def _poses(
    centers: Sequence[Sequence[float]] | NDArray[np.float64],
    points: ArrayLike = (),
    seen_by: Sequence[Sequence[int]] = (),
) -> Poses:
    """Return cameras a, b, … at centres, and points each seen by the cameras listed."""
    cameras = {chr(97 + k): Rigid3.from_center(np.eye(3), center) for k, center in enumerate(centers)}
    poses = Poses.without_points(cameras, frame="test", scale="test", metric=False)
    points = np.asarray(points, np.float64).reshape(-1, 3)
    observations = [(k, image) for k, images in enumerate(seen_by) for image in images]
    track_point, track_image = np.array(observations, np.int32).reshape(-1, 2).T
    rays = points[track_point] - poses.centers[track_image]
    result = dataclasses.replace(
        poses,
        points_in_world=points,
        point_colors_rgb=np.zeros((len(points), 3), np.uint8),
        point_errors_rad=np.zeros(len(points), np.float32),
        track_point_idx=track_point.copy(),
        track_image_idx=track_image.copy(),
        track_bearings=rays / np.linalg.norm(rays, axis=-1, keepdims=True) if len(rays) else np.zeros((0, 3)),
    )
    result.check()
    return result


def _wall(count: int, distance: float, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(size=(count, 3)) * (1, 1, 0.1) + (0, 0, distance)


def test_without_points_the_nearest_come_first() -> None:
    views = select_views(_poses([(k, 0, 0) for k in (0, 1, 2.1, 3.3, 4.6)]), sources=2)
    assert views.neighbours == {"a": ("b", "c"), "b": ("a", "c"), "c": ("b", "d"), "d": ("c", "e"), "e": ("d", "c")}


def test_without_points_a_neighbour_at_nearly_the_same_place_comes_last() -> None:
    views = select_views(_poses([(0, 0, 0), (0.01, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]), sources=4)
    assert views.neighbours["a"] == ("c", "d", "e", "b")


def test_shared_points_count_more_than_distance() -> None:
    centers = [(0, 0, 0), (0.5, 0, 0), (0.6, 0, 0)]
    points = np.concatenate([_wall(100, 3.0), _wall(20, -3.0)])
    seen_by = [(0, 2)] * 100 + [(0, 1)] * 20
    assert select_views(_poses(centers, points, seen_by)).neighbours["a"] == ("c", "b")


def test_a_good_angle_counts_more_than_many_points_without_parallax() -> None:
    centers = [(0, 0, 0), (0.03, 0, 0), (0.7, 0, 0)]
    seen_by = [(0, 1, 2)] * 60 + [(0, 1)] * 60
    neighbours = select_views(_poses(centers, _wall(120, 3.0), seen_by)).neighbours
    assert neighbours["a"] == ("c", "b")


def test_angles_outside_the_limits_do_not_count() -> None:
    centers = [(0, 0, 0), (0.5, 0, 0), (30, 0, 0)]
    poses = _poses(centers, _wall(50, 3.0), [(0, 2)] * 50)
    assert select_views(poses).neighbours["a"] == ("b", "c")
    assert select_views(poses, max_angle_deg=90.0).neighbours["a"] == ("c", "b")


def test_a_handful_of_shared_points_says_nothing() -> None:
    centers = [(0, 0, 0), (0.5, 0, 0), (0.6, 0, 0)]
    assert select_views(_poses(centers, _wall(5, 3.0), [(0, 2)] * 5)).neighbours["a"] == ("b", "c")


def test_only_images_with_a_source_elsewhere_are_references() -> None:
    assert select_views(_poses([(0, 0, 0)])).neighbours == {}
    assert select_views(_poses([])).neighbours == {}
    assert select_views(_poses([(1, 2, 3), (1, 2, 3)])).neighbours == {}
    views = select_views(_poses([(1, 2, 3), (1, 2, 3), (2, 2, 3)]))
    assert views.neighbours == {"a": ("c",), "b": ("c",), "c": ("a", "b")}
    views.check()


def test_the_order_of_the_tracks_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    seen_by = [tuple(sorted(rng.choice(6, rng.integers(2, 5), replace=False))) for _ in range(300)]
    poses = _poses(rng.normal(size=(6, 3)), _wall(300, 4.0), seen_by)
    order = rng.permutation(len(poses.track_point_idx))
    shuffled = dataclasses.replace(
        poses,
        track_point_idx=poses.track_point_idx[order],
        track_image_idx=poses.track_image_idx[order],
        track_bearings=poses.track_bearings[order],
    )
    assert select_views(poses).neighbours == select_views(shuffled).neighbours


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"sources": 0}, "sources must be at least 1"),
        ({"min_angle_deg": 30.0, "max_angle_deg": 20.0}, "min_angle_deg < max_angle_deg"),
    ],
)
def test_options_that_cannot_work_are_refused(options: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        select_views(_poses([(0, 0, 0)]), **options)
