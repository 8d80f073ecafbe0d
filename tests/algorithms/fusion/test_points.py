"""Few points out of many range maps: even, and with the right views."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.points.tracking import sample_surface, spread_points, track_points
from pano_mvs.algorithms.ranges.kernels_agreement import see_points
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import ray_grid
from pano_mvs.scene import Poses, RangeMap
from pano_mvs.scene.surfaces import SurfaceSamples, TrackedPoints
from pano_mvs.testing.room import capture_poses, default_room, range_along, render
from tests.oracles.surfaces import sees

Room = tuple[Poses, dict[str, RangeMap], dict[str, SurfaceSamples]]

SIZE = (128, 256)
NAMES = ("a/1.png", "a/2.png", "b/1.png")


@pytest.fixture(scope="module")
def room() -> Room:
    """Poses, true range maps and samples of three views."""
    cameras = capture_poses(3, seed=4)
    views = [render(default_room(), camera, SIZE, supersample=1) for camera in cameras]
    maps = {
        name: RangeMap(ranges, np.full(SIZE, 200, np.uint8)) for name, (_, ranges) in zip(NAMES, views, strict=True)
    }
    valid = np.ones(SIZE, np.bool_)
    samples = {name: sample_surface(views[idx][0], valid, maps[name], count=6000) for idx, name in enumerate(NAMES)}
    poses = Poses.without_points(dict(zip(NAMES, cameras, strict=True)), frame="room", scale="room", metric=False)
    return poses, maps, samples


def tracked(room: Room, **settings: Any) -> TrackedPoints:
    poses, maps, samples = room
    return track_points(samples, poses, maps.__getitem__, rng=np.random.default_rng(1), **settings)


def unevenness(points: NDArray[Any], spacing: float | NDArray[Any] = 1.0) -> float:
    """Standard deviation of the distance to the nearest neighbour in units of its mean; 0.52 if thrown."""
    nearest = np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1] / spacing
    return float(nearest.std() / nearest.mean())


def test_samples_are_even_over_the_sphere_and_on_the_surfaces(room: Room) -> None:
    poses, _, samples = room
    sample = samples[NAMES[1]]
    pose = poses.cam_from_world(1)
    sample.check()
    assert len(sample) > 5500
    true = range_along(default_room(), pose.center, sample.bearings @ pose.rotation)
    assert sample.ranges == pytest.approx(true, rel=1e-5)
    octants = np.bincount((sample.bearings > 0) @ [1, 2, 4], minlength=8)
    assert octants.max() / octants.min() < 1.1
    assert (np.abs(sample.bearings[:, 1]) > np.sin(np.radians(75))).mean() == pytest.approx(
        1 - np.sin(np.radians(75)), rel=0.2
    )


def test_masked_and_doubtful_pixels_give_no_samples() -> None:
    valid = ray_grid(SIZE)[..., 1] < 0.5
    confidence = np.where(ray_grid(SIZE)[..., 0] < 0, 90, 200).astype(np.uint8)
    image = np.zeros((*SIZE, 3), np.uint8)
    sample = sample_surface(image, valid, RangeMap(np.full(SIZE, 2, np.float32), confidence))
    assert len(sample)
    assert (sample.bearings[:, 1] < 0.5).all()
    assert (sample.bearings[:, 0] >= 0).all()
    with pytest.raises(UsageError, match="differ in size"):
        sample_surface(image[1:], valid, RangeMap(np.full(SIZE, 2, np.float32), confidence))


@pytest.mark.parametrize("seed", range(3))
def test_points_are_spread_like_discs(seed: int) -> None:
    """On a plane sampled ever more densely to one side."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.random((30_000, 2)) ** (3, 1), np.zeros(30_000)])
    kept = spread_points(points, np.ones(len(points)), 1500, rng=rng)
    assert len(kept) == len(set(kept.tolist())) == 1500
    assert (np.diff(kept) > 0).all()
    assert unevenness(points[kept]) < 0.2
    assert unevenness(points[rng.choice(len(points), 1500, replace=False)]) > 0.5
    assert (points[kept, 0] > 0.5).mean() == pytest.approx(0.5, abs=0.06)


def test_distances_go_with_the_spacing() -> None:
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.random((40_000, 2)), np.zeros(40_000)])
    spacing = np.where(points[:, 0] < 0.5, 1.0, 3.0)
    kept = spread_points(points, spacing, 1000, rng=rng)
    dense, sparse = points[kept[spacing[kept] == 1]], points[kept[spacing[kept] == 3]]
    assert len(dense) / len(sparse) == pytest.approx(9, rel=0.25)


@pytest.mark.parametrize("total", [0, 1, 2, 7, 40])
def test_no_more_points_than_there_are(total: int) -> None:
    points = np.random.default_rng(0).random((total, 3))
    assert spread_points(points, np.ones(total), 40, rng=np.random.default_rng(0)).tolist() == list(range(total))


def test_points_in_one_place_are_one() -> None:
    points = np.zeros((100, 3))
    assert 1 <= len(spread_points(points, np.ones(100), 5, rng=np.random.default_rng(0))) <= 5


def test_wrong_spacings_are_refused() -> None:
    with pytest.raises(UsageError, match="positive spacings"):
        spread_points(np.zeros((3, 3)), np.array([1.0, 0.0, 1.0]), 2, rng=np.random.default_rng(0))


def test_points_are_on_the_walls_even_and_seen_where_the_tracks_say(room: Room) -> None:
    poses, _, _ = room
    found = tracked(room, count=3000)
    found.check()
    assert len(found) == 3000
    assert found.names == NAMES
    seen, wrong = 0, 0
    for idx in range(3):
        pose = poses.cam_from_world(idx)
        here = found.track_image_idx == idx
        points = found.points_in_world[found.track_point_idx[here]]
        in_cam = pose.apply(points)
        distance = np.linalg.norm(in_cam, axis=1)
        assert found.track_bearings[here] == pytest.approx(in_cam / distance[:, None], abs=1e-9)
        true = range_along(default_room(), pose.center, (points - pose.center) / distance[:, None])
        wrong += int((np.abs(true / distance - 1) > 0.021).sum())
        seen += len(points)
    assert wrong < 0.003 * seen
    assert seen > 2.7 * 3000, "nearly all of the room is seen from everywhere"
    assert np.bincount(found.track_point_idx).min() >= 2
    assert found.errors_rad.max() < 2 * np.pi / SIZE[1]
    nearest = cKDTree(poses.centers).query(found.points_in_world)[0]
    assert unevenness(found.points_in_world, np.sqrt(nearest)) < 0.25


def test_what_a_view_does_not_see_is_not_in_its_tracks(room: Room) -> None:
    """A view whose ranges are nearer everywhere sees nothing; one that is not sure does not count."""
    poses, maps, samples = room
    nearer = RangeMap(0.8 * maps[NAMES[2]].range, maps[NAMES[2]].confidence)
    doubtful = RangeMap(maps[NAMES[2]].range, np.full(SIZE, 40, np.uint8))
    for other in (nearer, doubtful):
        mine = {name: samples[name] for name in NAMES[:2]} | {
            NAMES[2]: sample_surface(np.zeros((*SIZE, 3), np.uint8), np.zeros(SIZE, np.bool_), other)
        }
        found = tracked((poses, maps | {NAMES[2]: other}, mine), count=500)
        assert set(found.track_image_idx.tolist()) == {0, 1}


def test_few_neighbours_make_short_tracks_that_have_the_own_view(room: Room) -> None:
    found = tracked(room, count=500, neighbours=2)
    assert np.bincount(found.track_point_idx).max() <= 3
    alone = tracked(room, count=500, neighbours=1, min_views=1)
    assert np.bincount(alone.track_point_idx).min() >= 1


def test_views_without_samples_or_pose_are_left_out(room: Room) -> None:
    poses, maps, samples = room
    found = tracked((poses, maps, {NAMES[0]: samples[NAMES[0]], "c.png": samples[NAMES[1]]}), count=50, min_views=1)
    assert found.names == NAMES[:1]
    nothing = tracked((poses, maps, {}), count=50)
    nothing.check()
    assert len(nothing) == 0


def test_points_join_poses_behind_or_in_place_of_theirs(room: Room) -> None:
    poses = room[0]
    found = tracked(room, count=300)
    both = found.joined_to(found.joined_to(poses, keep_points=False), keep_points=True)
    both.check()
    assert len(both.points_in_world) == 600
    np.testing.assert_array_equal(both.track_point_idx[-5:], found.track_point_idx[-5:] + 300)
    fewer = Poses.without_points({NAMES[1]: poses.cam_from_world(1)}, frame="", scale="", metric=False)
    joined = found.joined_to(fewer, keep_points=True)
    joined.check()
    assert len(joined.track_point_idx) == int((found.track_image_idx == 1).sum())


@pytest.mark.kernel("ranges.kernels_agreement")
def test_the_compiled_test_is_the_plain_one(room: Room) -> None:
    """On points of the room, some moved, and a range map with holes and doubtful pixels."""
    poses, maps, samples = room
    rng = np.random.default_rng(6)
    ranges, confidence = maps[NAMES[2]].range.copy(), rng.integers(30, 200, SIZE).astype(np.uint8)
    ranges[rng.random(SIZE) < 0.05] = np.nan
    confidence[np.isnan(ranges)] = 0
    seeing, pose, home = RangeMap(ranges, confidence), poses.cam_from_world(2), poses.centers[0]
    sample = samples[NAMES[0]]
    in_cam = sample.bearings * (sample.ranges * rng.choice([1, 1, 1, 0.99, 1.05], len(sample)))[:, None]
    points = poses.cam_from_world(0).inverse().apply(in_cam)[::20]
    seen, errors, bearings = np.zeros(len(points), np.bool_), np.zeros(len(points)), np.zeros((len(points), 3))
    view = pose.rotation.copy(), pose.translation.copy()
    homes, limits = np.broadcast_to(home, points.shape).copy(), np.array([0.02, 0.05, 64.0])
    see_points(points, homes, 2 * np.pi / SIZE[1], view, ranges, confidence, limits, seen, errors, bearings)
    expected = [sees(point, home, pose, seeing, 0.02, 64) for point in points]
    assert seen.tolist() == [found is not None for found in expected]
    assert 20 < seen.sum() < 0.8 * len(points)
    assert bearings[seen] == pytest.approx(np.array([found[0] for found in expected if found]), abs=1e-9)
    assert errors[seen] == pytest.approx(np.array([found[1] for found in expected if found]), abs=2e-7)
