"""Normals, the voted cloud and its smoothing, and their compiled parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from pano_mvs.algorithms.fusion import fuse
from pano_mvs.algorithms.fusion.fuse import fuse_stream, join_clouds
from pano_mvs.algorithms.fusion.kernels_fuse import add_source, find_supported
from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.fusion.smooth import smooth_surfaces, surface_heights
from pano_mvs.algorithms.fusion.view import FusionView, nearest_views, normals_from_range
from pano_mvs.algorithms.panoramas import columns_per_step
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, angle_between, ray_grid, rotation_from_rotvec, sines_of_grid
from pano_mvs.scene import PointCloud, RangeMap
from pano_mvs.testing.room import capture_poses, default_room, range_along
from tests.algorithms.fusion.whole import fuse_reference, fuse_views, thin_by_voxels
from tests.algorithms.range_scenes import as_map, box_range, room_range
from tests.known import known
from tests.oracles import surfaces as oracle

SIZE = (128, 256)
POSES = capture_poses(3, seed=2, spread=0.4)
ONCE = FusionSettings(max_footprint_ratio=1)


def painted(ranges: NDArray[Any], pose: Rigid3) -> NDArray[np.uint8]:
    """A picture whose colours are a smooth function of the place in the world."""
    points = pose.inverse().apply(ray_grid(ranges.shape) * ranges[..., None])
    result: NDArray[np.uint8] = np.rint(127 + 100 * np.sin(points)).clip(0, 255).astype(np.uint8)
    return result


@pytest.fixture(scope="module")
def views() -> list[FusionView]:
    room = default_room()
    maps = [room_range(room, pose, SIZE) for pose in POSES]
    return [FusionView(as_map(m), pose, painted(m, pose)) for m, pose in zip(maps, POSES, strict=True)]


class TestNormals:
    @pytest.mark.kernel("fusion.kernels_fuse")
    def test_equal_the_plain_fit(self) -> None:
        size = (16, 32)
        ranges = 2 + 0.3 * np.random.default_rng(0).random(size).astype(np.float32)
        ranges[3, 5:9], ranges[8:, 20:] = np.nan, 5
        expected = oracle.normals(ranges, 2, 0.05, columns_per_step(size, steps=5))
        found = normals_from_range(ranges)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
        defined = np.isfinite(expected[..., 0])
        assert defined.mean() > 0.5
        assert np.abs(found - expected)[defined].max() < 1e-3

    def test_of_a_ball_off_centre_are_its_radii(self) -> None:
        center = np.array([0.5, 0.3, -0.4])
        rays = ray_grid(SIZE)
        along = rays @ center
        ranges = along + np.sqrt(along**2 - center @ center + 4)
        expected = center - ranges[..., None] * rays
        found = normals_from_range(ranges.astype(np.float32))
        assert np.degrees(angle_between(found, expected)).max() < 1

    def test_of_walls_are_theirs_over_seam_and_poles(self) -> None:
        ranges, expected = box_range((256, 512))
        found = normals_from_range(ranges)
        error = np.degrees(angle_between(found, expected))
        same = np.ones(ranges.shape, bool)
        for d_row in range(-6, 7):
            for d_column in range(-6, 7):
                same &= (np.roll(expected, (d_row, d_column), (0, 1)) == expected).all(-1)
        same[:3], same[-3:] = True, True
        assert same.mean() > 0.7
        assert error[same].max() < 1
        assert np.median(error) < 0.01

    def test_do_not_mix_two_surfaces(self) -> None:
        rays = ray_grid(SIZE)
        ranges = (3 / np.maximum(rays[..., 2], 0.1)).astype(np.float32)  # a wall ahead
        ranges[55:70, 110:140] = 2.5  # a piece of a ball before it
        error_wall = np.degrees(angle_between(normals_from_range(ranges), (0, 0, -1)))
        error_ball = np.degrees(angle_between(normals_from_range(ranges), -rays))
        assert error_wall[50:75, [108, 109, 140, 141]].max() < 1
        # Beside an edge only one side of the curved window is left, whose middle lies up to a pixel and a half away.
        assert error_ball[55:70, 110:140].max() < 1.5 * 360 / SIZE[1]

    def test_lonely_pixels_have_none(self) -> None:
        ranges = np.full((16, 32), np.nan, np.float32)
        ranges[8, 4:7] = 2
        assert np.isnan(normals_from_range(ranges)).all()

    def test_impossible_maps_are_named(self) -> None:
        with pytest.raises(UsageError, match="even W"):
            normals_from_range(np.ones((16, 31), np.float32))


class TestFusion:
    def test_true_ranges_give_the_true_surface_and_its_colours(self, views: list[FusionView]) -> None:
        cloud = fuse_views(views)
        cloud.check()
        points = cloud.points_in_world.astype(np.float64)
        # Distance to the surface along the ray from the first camera, where it is not hidden from there.
        distance = np.linalg.norm(points, axis=1)
        true = range_along(default_room(), np.zeros(3), points / distance[:, None])
        visible = true > distance * 0.98
        assert visible.mean() > 0.6
        error = np.abs(true - distance)[visible] / distance[visible]
        assert np.median(error) < 5e-4
        assert np.quantile(error, 0.9) < 0.01
        expected = np.rint(127 + 100 * np.sin(points))
        assert np.median(np.abs(cloud.colors_rgb - expected)) <= 1
        assert (np.sum(cloud.normals_in_world * points, axis=1)[visible] < 0).mean() > 0.98

    @pytest.mark.slow
    def test_each_surface_is_written_once_and_none_is_lost(self, views: list[FusionView]) -> None:
        cloud = fuse_views(views, ONCE)
        alone = [len(fuse_reference(view, [], [], settings=FusionSettings(min_views=1))) for view in views]
        assert 0.4 * np.mean(alone) < len(cloud) < 1.3 * np.mean(alone)
        truth = views[0].range_map.range
        points = (ray_grid(SIZE) * truth[..., None])[::4, ::8].reshape(-1, 3)
        spacing = (2 * np.pi / SIZE[1] * truth[::4, ::8]).ravel()
        nearest = np.array([np.linalg.norm(cloud.points_in_world - point, axis=1).min() for point in points])
        assert (nearest < 4 * spacing).mean() > 0.96

    def test_the_view_that_sees_best_writes(self) -> None:
        """Two cameras on the axis of a ball: each writes its own half."""
        poses = [Rigid3.from_center(np.eye(3), (x, 0, 0)) for x in (-0.8, 0.8)]
        views = []
        for pose in poses:
            rays = ray_grid(SIZE)
            along = -(rays @ pose.center)
            ranges = along + np.sqrt(along**2 - pose.center @ pose.center + 4)
            views.append(FusionView(as_map(ranges), pose, np.zeros((*SIZE, 3), np.uint8)))
        left = fuse_reference(views[0], [], views[1:], settings=ONCE)
        right = fuse_reference(views[1], views[:1], [], settings=ONCE)
        assert (left.points_in_world[:, 0] < 0.15).mean() > 0.99
        assert (right.points_in_world[:, 0] > -0.15).mean() > 0.99
        cloud = fuse_views(views, ONCE)
        np.testing.assert_allclose(np.linalg.norm(cloud.points_in_world, axis=1), 2, rtol=2e-3)
        inwards = -cloud.points_in_world / 2
        assert np.degrees(angle_between(cloud.normals_in_world, inwards)).max() < 1

    def test_what_no_other_view_confirms_is_dropped(self, views: list[FusionView]) -> None:
        wrong = np.zeros(SIZE, bool)
        wrong[50:70, 100:140] = True
        ranges = np.where(wrong, 0.7 * views[0].range_map.range, views[0].range_map.range)
        broken = [FusionView(as_map(ranges), views[0].pose, views[0].image), *views[1:]]
        points = fuse_views(broken).points_in_world
        distance = np.linalg.norm(points, axis=1)
        true = range_along(default_room(), np.zeros(3), points / distance[:, None].astype(np.float64))
        assert (distance < 0.9 * true).mean() < 1e-3

    def test_min_views_and_min_confidence_are_obeyed(self, views: list[FusionView]) -> None:
        assert fuse_views(views, FusionSettings(min_views=3, min_support=None)).view_counts.min() == 3
        assert len(fuse_views(views[:1])) == 0
        assert len(fuse_views(views[:1], FusionSettings(min_views=1))) > 0.5 * np.prod(SIZE)
        filled = [FusionView(as_map(v.range_map.range, 63), v.pose, v.image) for v in views]
        assert len(fuse_views(filled)) == 0
        assert len(fuse_views(filled, FusionSettings(min_confidence=1))) == len(fuse_views(views))
        assert len(fuse_views([])) == 0

    def test_points_are_even_over_the_sphere(self) -> None:
        """A ball around the camera: as many points above 60° as its solid angle says, and so at the pole."""
        view = FusionView(as_map(np.full(SIZE, 2.0)), Rigid3.identity(), np.zeros((*SIZE, 3), np.uint8))
        for stride in (1, 2, 3):
            points = fuse_views([view], FusionSettings(min_views=1, stride=stride)).points_in_world
            for limit in (np.cos(np.radians(20)), np.sin(np.radians(60)), 0.0):
                expected = (1 - limit) / 2
                assert (points[:, 1] / 2 > limit).mean() == pytest.approx(expected, rel=0.15)
            assert len(points) == pytest.approx(np.prod(SIZE) * 2 / np.pi / stride**2, rel=0.05)

    def test_impossible_calls_are_named(self, views: list[FusionView]) -> None:
        with pytest.raises(UsageError, match="min_views must be at least 1, got 0"):
            fuse_views(views, FusionSettings(min_views=0))
        small = FusionView(views[0].range_map, views[0].pose, views[0].image[::2])
        with pytest.raises(UsageError, match="image must be"):
            fuse_views([small])


def ball_views(
    count: int,
    ranges_of: Callable[[NDArray[np.float64], int], NDArray[np.float64]] = lambda ranges, idx: ranges,
    **fields: Any,
) -> list[FusionView]:
    """Cameras near the middle of a ball of radius 2."""
    views = []
    for idx in range(count):
        center = 0.25 * np.array([np.cos(2 * idx), 0.3 * np.sin(3 * idx), np.sin(2 * idx)])
        along = -(ray_grid(SIZE) @ center)
        ranges = along + np.sqrt(along**2 - center @ center + 4)
        pose = Rigid3.from_center(np.eye(3), center)
        views.append(FusionView(as_map(ranges_of(ranges, idx)), pose, np.zeros((*SIZE, 3), np.uint8), **fields))
    return views


def from_ball(cloud: PointCloud) -> NDArray[np.float64]:
    result: NDArray[np.float64] = np.linalg.norm(cloud.points_in_world.astype(np.float64), axis=1) - 2
    return result


class TestMerging:
    @pytest.mark.parametrize("count", [2, 4, 6])
    def test_noise_goes_down_with_the_root_of_the_number_of_views(self, count: int) -> None:
        def noisy(ranges: NDArray[np.float64], idx: int) -> NDArray[np.float64]:
            return ranges * (1 + 0.001 * np.random.default_rng(idx).normal(size=SIZE))

        views = ball_views(count, noisy)
        alone = from_ball(fuse_views(views, FusionSettings(merge_within=0.0))).std()
        merged = from_ball(fuse_views(views, FusionSettings(merge_within=0.02)))
        assert alone == pytest.approx(0.002, rel=0.05)
        # Between its pixels a source is interpolated, which averages as well.
        assert 0.6 / np.sqrt(count) < merged.std() / alone < 1.1 / np.sqrt(count)
        assert abs(merged.mean()) < 2e-4

    def test_what_lies_apart_is_not_averaged_though_it_agrees(self) -> None:
        views = ball_views(2, lambda ranges, idx: ranges * (1 + 0.015 * idx))
        cloud = fuse_views(views)
        assert cloud.view_counts.min() == 2
        error = from_ball(cloud)
        assert np.minimum(np.abs(error), np.abs(error - 0.03)).max() < 5e-3

    def test_confidence_is_the_largest_of_the_views_that_agree(self) -> None:
        views = ball_views(3)
        sure = FusionView(as_map(views[2].range_map.range, 200), views[2].pose, views[2].image)
        assert set(known(fuse_views(views).confidence)) == {100}
        assert set(known(fuse_views([*views[:2], sure]).confidence)) == {200}


class TestOutliers:
    def test_a_point_that_most_see_through_is_removed_though_one_agrees(self) -> None:
        """Two views share a false wall before the ball, three that are sure of themselves look through it."""

        def walled(ranges: NDArray[np.float64], idx: int) -> NDArray[np.float64]:
            center = ball_poses[idx].center
            rays = ray_grid(SIZE)
            wall = (1.2 - center[2]) / np.maximum(rays[..., 2], 1e-3)
            return np.where((rays[..., 2] > 0.9) & (idx < 2), wall, ranges)

        ball_poses = [view.pose for view in ball_views(5)]
        views = [FusionView(as_map(view.range_map.range, 200), view.pose, view.image) for view in ball_views(5, walled)]
        false = np.abs(from_ball(fuse_views(views[:3]))) > 0.3
        assert false.sum() > 300
        assert (np.abs(from_ball(fuse_views(views))) > 0.3).sum() == 0
        unsure = [FusionView(as_map(view.range_map.range, 100), view.pose, view.image) for view in views]
        assert (np.abs(from_ball(fuse_views(unsure))) > 0.3).sum() > 300

    def test_a_surface_vouches_for_its_own_pixels_only(self) -> None:
        """One view alone sees a strip beside what both see, and an island of its own before the ball."""
        island = np.zeros(SIZE, bool)
        island[60:70, 100:110] = True

        def partly(ranges: NDArray[np.float64], idx: int) -> NDArray[np.float64]:
            ranges = np.where(island & (idx == 0), 0.7 * ranges, ranges)
            return np.where((np.arange(SIZE[1]) > 128) & (idx == 1), np.nan, ranges)

        views = ball_views(2, partly)
        strict = fuse_reference(views[0], [], views[1:], settings=FusionSettings(min_support=None))
        cloud = fuse_reference(views[0], [], views[1:])
        assert strict.view_counts.min() == 2
        added = cloud.view_counts == 1
        assert SIZE[0] * 0.5 < added.sum() < SIZE[0] * 4
        assert np.abs(from_ball(cloud)).max() < 3e-3

    def test_no_point_comes_from_a_masked_pixel_nor_by_its_vote(self) -> None:
        mask = ray_grid(SIZE)[..., 1] < 0.5
        views = ball_views(3, mask=mask)
        cloud = fuse_views(views, FusionSettings(even_density=False))
        below = [(cloud.points_in_world - view.pose.center) for view in views]
        shares = np.array([points[:, 1] / np.linalg.norm(points, axis=1) for points in below])
        assert (shares < 0.55).sum(axis=0).min() >= 2
        assert len(cloud) > 0.6 * mask.sum() * 3
        half = [views[0], *(FusionView(v.range_map, v.pose, v.image) for v in views[1:])]
        written = fuse_reference(half[0], [], half[1:])
        direction = written.points_in_world - views[0].pose.center
        assert (direction[:, 1] / np.linalg.norm(direction, axis=1)).max() < 0.51
        with pytest.raises(UsageError, match="mask must have the size"):
            fuse_views(ball_views(2, mask=mask[1:]))


class TestStreaming:
    @pytest.mark.slow
    @pytest.mark.parametrize("settings", [FusionSettings(neighbours=2), FusionSettings(neighbours=3, voxel_size=0.05)])
    def test_equals_all_at_once_and_holds_few(self, settings: FusionSettings) -> None:
        views = ball_views(7)
        loads = []

        def load(idx: int) -> FusionView:
            loads.append(idx)
            return views[idx]

        streamed = fuse_stream([view.pose for view in views], load, settings)
        whole = fuse_views(views, settings, threads=3)
        for name, values in vars(streamed).items():
            assert np.asarray(values).tobytes() == np.asarray(getattr(whole, name)).tobytes()
        assert set(loads) == set(range(7))
        assert len(loads) > 7  # some were dropped and loaded again

    def test_neighbours_are_the_nearest_in_rising_order(self) -> None:
        poses = [Rigid3.from_center(np.eye(3), (x, 0, 0)) for x in (0, 10, 1, 3, 3)]
        assert nearest_views(poses, 2) == [[2, 3], [3, 4], [0, 3], [2, 4], [2, 3]]
        assert nearest_views(poses, 9) == [[o for o in range(5) if o != i] for i in range(5)]
        assert nearest_views(poses, 0) == [[], [], [], [], []]

    def test_without_neighbours_each_view_stands_alone(self) -> None:
        views = ball_views(3)
        assert len(fuse_views(views, FusionSettings(neighbours=0))) == 0
        alone = fuse_views(views, FusionSettings(neighbours=0, min_views=1, even_density=False))
        assert len(alone) == sum(int(view.range_map.valid.sum()) for view in views)

    def test_normals_that_came_with_the_ranges_are_taken(self) -> None:
        ahead = np.tile(np.array([0, 0, -1], np.float16), (*SIZE, 1))
        views = [
            FusionView(RangeMap(v.range_map.range, v.range_map.confidence, ahead), v.pose, v.image)
            for v in ball_views(2)
        ]
        np.testing.assert_array_equal(np.unique(fuse_views(views).normals_in_world, axis=0), [[0, 0, -1]])


class TestVoxels:
    def cloud(self, points: ArrayLike) -> PointCloud:
        places = np.array(points, np.float32)
        count = len(places)
        normals = np.tile(np.array([0, 0, 1], np.float32), (count, 1))
        colors = np.arange(3 * count, dtype=np.uint8).reshape(count, 3)
        return PointCloud(places, normals, colors, np.arange(1, count + 1, dtype=np.uint8))

    def test_one_point_is_left_in_each_voxel(self) -> None:
        points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
        thin = thin_by_voxels(self.cloud(points), 0.25)
        thin.check()
        occupied = np.unique(np.floor(points / 0.25), axis=0)
        assert len(thin) == len(occupied)
        np.testing.assert_array_equal(np.unique(np.floor(thin.points_in_world / 0.25), axis=0), occupied)
        np.testing.assert_allclose(np.linalg.norm(thin.normals_in_world, axis=1), 1, rtol=1e-6)

    def test_points_are_averaged_by_their_views_in_order_of_appearance(self) -> None:
        thin = thin_by_voxels(self.cloud([[5.1, 0.5, 0.5], [0.1, 0.5, 0.5], [5.4, 0.5, 0.5]]), 1.0)
        np.testing.assert_allclose(thin.points_in_world, [[5.325, 0.5, 0.5], [0.1, 0.5, 0.5]], rtol=1e-6)
        np.testing.assert_array_equal(thin.view_counts, [3, 2])
        np.testing.assert_array_equal(thin.colors_rgb[0], np.rint((np.arange(3) + 3 * np.arange(6, 9)) / 4))

    def test_clouds_added_in_turn_are_one_cloud(self, monkeypatch: pytest.MonkeyPatch) -> None:
        rng = np.random.default_rng(1)
        parts = [self.cloud(rng.uniform(-1, 1, (200, 3))) for _ in range(5)]
        whole = thin_by_voxels(join_clouds(parts), 0.3)
        for waiting in (10, 10**9):
            monkeypatch.setattr(fuse, "_MIN_WAITING", waiting)
            grid = fuse.VoxelGrid(0.3)
            for part in parts:
                grid.add(part)
            for name, values in vars(grid.cloud()).items():
                if values is not None:
                    np.testing.assert_allclose(values, getattr(whole, name), rtol=1e-5, atol=1e-6)

    def test_normals_that_cancel_leave_the_first(self) -> None:
        normals = np.array([[0, 0, 1], [0, 0, -1]], np.float32)
        one = np.ones(2, np.uint8)
        cloud = PointCloud(np.zeros((2, 3), np.float32), normals, np.zeros((2, 3), np.uint8), one)
        np.testing.assert_array_equal(thin_by_voxels(cloud, 1.0).normals_in_world, [[0, 0, 1]])

    def test_nothing_stays_nothing_and_a_bad_size_is_named(self) -> None:
        assert len(thin_by_voxels(join_clouds([]), 0.1)) == 0
        with pytest.raises(UsageError, match="voxel_size"):
            thin_by_voxels(join_clouds([]), 0)


class TestUncertainty:
    @staticmethod
    def with_uncertainty(view: FusionView, sigma: float, *, factor: float = 1.0) -> FusionView:
        ranges = (view.range_map.range * np.float32(factor)).astype(np.float32)
        known = replace(view.range_map, range=ranges, uncertainty=np.full(ranges.shape, sigma, np.float16))
        return replace(view, range_map=known)

    @staticmethod
    def error(cloud: PointCloud) -> float:
        """Return the median distance of the points from the room's walls along the rays of the first camera."""
        in_cam = POSES[0].apply(cloud.points_in_world.astype(float))
        distance = np.linalg.norm(in_cam, axis=1)
        rays = (in_cam / distance[:, None]) @ POSES[0].rotation
        true = range_along(default_room(), np.asarray(POSES[0].center), rays)
        return float(np.median(np.abs(distance / true - 1)))

    def test_precise_views_count_more(self, views: list[FusionView]) -> None:
        settings = FusionSettings(smooth=False)
        sigmas, factors = (0.03, 0.003, 0.003), (1.006, 1.0, 1.0)
        equal, weighted = (
            fuse_views(
                [
                    self.with_uncertainty(view, 0.01 if same else sigma, factor=factor)
                    for view, sigma, factor in zip(views, sigmas, factors, strict=True)
                ],
                settings,
            )
            for same in (True, False)
        )
        assert self.error(weighted) < 0.5 * self.error(equal)

    def test_points_above_the_limit_are_left_out(self, views: list[FusionView]) -> None:
        sure = [self.with_uncertainty(view, 0.01) for view in views]
        unsure = [self.with_uncertainty(view, 0.3) for view in views]
        cloud = fuse_views(sure)
        assert cloud.uncertainty is not None
        assert len(cloud.uncertainty) == len(cloud)
        assert len(fuse_views(unsure)) == 0
        assert len(fuse_views(unsure, FusionSettings(max_uncertainty=None))) == len(cloud)

    def test_views_of_unknown_uncertainty_are_fused_as_before(self, views: list[FusionView]) -> None:
        plain, limited = (
            fuse_views(views, FusionSettings(smooth=s, max_uncertainty=m)) for s, m in ((False, None), (True, 0.001))
        )
        assert plain.uncertainty is None
        np.testing.assert_array_equal(plain.points_in_world, limited.points_in_world)


TINY, SOURCE_SIZE = (12, 24), (10, 20)
SOURCE_LIMITS = np.array([0.05, 0.2, 0.05, 1.05, 0.03, 100.0])
FIELDS = ("yields", "counts", "violations", "confidence", "sums", "colors", "precisions")


def rough_sphere(rng: np.random.Generator, size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Return the ranges of a sphere of radius 2 with noise, steps to both sides and holes."""
    ranges = 2 + rng.normal(0, 0.03, size_hw)
    ranges[rng.random(size_hw) < 0.1] *= 0.6
    ranges[rng.random(size_hw) < 0.1] *= 1.6
    ranges[rng.random(size_hw) < 0.1] = np.nan
    return ranges.astype(np.float32)


@pytest.mark.kernel("fusion.kernels_fuse")
@pytest.mark.parametrize("with_uncertainty", [False, True])
def test_what_a_source_adds_equals_the_plain_sums(with_uncertainty: bool) -> None:
    rng = np.random.default_rng(20)
    ranges, source_ranges = rough_sphere(rng, TINY), rough_sphere(rng, SOURCE_SIZE)
    rays = ray_grid(TINY)
    drawn = -rays + rng.normal(0, 0.5, rays.shape)
    normals = (drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)).astype(np.float32)
    written = rng.random(TINY) < 0.8
    confidence = rng.integers(30, 200, SOURCE_SIZE).astype(np.uint8)
    image = rng.integers(0, 256, (*SOURCE_SIZE, 3)).astype(np.uint8)
    pose = Rigid3(rotation_from_rotvec((0.4, -1.9, 0.7)), np.array([0.05, -0.03, 0.06]))
    uncertainty = rng.uniform(0.01, 0.2, SOURCE_SIZE if with_uncertainty else (0, 0)).astype(np.float32)
    found: dict[str, NDArray[Any]] = {
        "yields": np.zeros(TINY, np.bool_),
        "counts": np.zeros(TINY, np.uint8),
        "violations": np.zeros(TINY, np.uint8),
        "confidence": np.zeros(TINY, np.uint8),
        "sums": np.zeros((*TINY, 4)),
        "colors": np.zeros((*TINY, 4)),
        "precisions": np.zeros(TINY if with_uncertainty else (0, 0)),
    }
    source = (np.array(pose.rotation), np.array(pose.translation), source_ranges, confidence, image, uncertainty)
    for rows in ((0, 5), (5, 12)):
        add_source(
            (ranges, sines_of_grid(TINY), normals, written),
            source,
            SOURCE_LIMITS,
            rows,
            tuple(found[name] for name in FIELDS),
        )
    expected = oracle.add_source(
        (ranges, rays, normals, written), pose, (source_ranges, confidence, image, uncertainty), SOURCE_LIMITS
    )
    for name in FIELDS:  # as plain Python, quotients of ranges are float32
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-3, atol=1e-5, err_msg=name)
    assert 0.2 < found["counts"].mean() < 0.8
    assert found["violations"].sum() > 5
    assert 0.1 < found["yields"][found["counts"] > 0].mean() < 0.9
    merged, colored = (found[name][..., 3] > 0 for name in ("sums", "colors"))
    assert 0 < (colored & ~merged).sum() < merged.sum()


@pytest.mark.kernel("fusion.kernels_fuse")
@pytest.mark.parametrize("least", [0.2, 0.4])
def test_support_of_a_surface_equals_the_plain_count(least: float) -> None:
    rng = np.random.default_rng(21)
    ranges = rough_sphere(rng, TINY)
    confirmed = np.isfinite(ranges) & (rng.random(TINY) < 0.6)
    stretches = columns_per_step(TINY, steps=5)
    assert stretches.max() > 1
    found = find_supported(ranges, confirmed, stretches, 2, 0.03, least)
    expected = oracle.supported(ranges, confirmed, stretches, radius=2, max_step=0.03, least=least)
    np.testing.assert_array_equal(found, expected)
    assert 0 < found.sum() < (np.isfinite(ranges) & ~confirmed).sum()


CENTERS = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])


def cloud_of(points: NDArray[np.float64], normals: NDArray[np.float64], sigma: float) -> PointCloud:
    count = len(points)
    return PointCloud(
        points.astype(np.float32),
        np.broadcast_to(normals, points.shape).astype(np.float32),
        np.zeros((count, 3), np.uint8),
        np.full(count, 2, np.uint8),
        uncertainty=np.full(count, sigma, np.float32),
    )


def noisy_wall(rng: np.random.Generator, *, noise: float, sigma: float, count: int = 4000) -> PointCloud:
    """Return a noisy noisy_wall at z = 3, 2 × 2 in size."""
    place = rng.uniform(-1, 1, (count, 2))
    points = np.column_stack([place, 3 + rng.normal(0, noise, count)])
    return cloud_of(points, np.array([0.0, 0.0, -1.0]), sigma)


@pytest.mark.kernel("fusion.kernels_smooth")
def test_heights_equal_the_plain_fit() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (150, 3)) * (1, 1, 0.1)
    normals = rng.normal((0, 0, 1), 0.2, (150, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sigmas = rng.uniform(0.1, 0.4, 150).astype(np.float32)
    arrays = points.astype(np.float32), normals.astype(np.float32), sigmas
    found, expected = surface_heights(*arrays, per_column=1000, threads=2), oracle.surface_heights(*arrays)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert 0.1 < (expected != 0).mean() < 0.95


@pytest.mark.kernel("fusion.kernels_smooth")
@pytest.mark.parametrize("points_of_slab", [1, 700, 2500])
def test_slabs_change_no_height(points_of_slab: int) -> None:
    rng = np.random.default_rng(7)
    wall = noisy_wall(rng, noise=0.03, sigma=0.06)
    sigmas = rng.uniform(0.01, 0.2, len(wall)).astype(np.float32)
    arrays = wall.points_in_world, wall.normals_in_world, sigmas
    chosen = rng.random(len(wall)) < 0.8
    whole = surface_heights(*arrays, chosen=chosen)
    found = surface_heights(*arrays, chosen=chosen, points_of_slab=points_of_slab)
    assert (whole != 0).mean() > 0.2
    np.testing.assert_array_equal(found, whole)


def test_a_noisy_wall_becomes_thin() -> None:
    before = noisy_wall(np.random.default_rng(0), noise=0.03, sigma=0.06)
    after = smooth_surfaces(before, CENTERS)
    inner = np.abs(before.points_in_world[:, :2]).max(axis=1) < 0.8
    thickness = [float(cloud.points_in_world[inner, 2].std()) for cloud in (before, after)]
    assert thickness[1] < 0.4 * thickness[0]
    assert abs(after.points_in_world[inner, 2].mean() - 3) < 0.006


def test_no_point_moves_by_more_than_its_uncertainty() -> None:
    before = noisy_wall(np.random.default_rng(1), noise=0.03, sigma=0.02)
    moves = np.linalg.norm(smooth_surfaces(before, CENTERS).points_in_world - before.points_in_world, axis=1)
    assert 0.01 < moves.max() < 0.0201


def test_two_surfaces_farther_apart_than_their_uncertainty_stay_apart() -> None:
    rng = np.random.default_rng(2)
    first, second = (noisy_wall(rng, noise=0.003, sigma=0.01, count=3000) for _ in range(2))
    points = np.concatenate([first.points_in_world, second.points_in_world + np.array([0, 0, 0.1])])
    both = cloud_of(points, np.array([0.0, 0.0, -1.0]), 0.01)
    after = smooth_surfaces(both, CENTERS).points_in_world[:, 2]
    np.testing.assert_allclose([after[:3000].mean(), after[3000:].mean()], [3, 3.1], atol=0.001)


def test_the_frame_and_the_number_of_threads_do_not_matter() -> None:
    before = noisy_wall(np.random.default_rng(4), noise=0.03, sigma=0.06, count=600)
    plain = smooth_surfaces(before, CENTERS)
    np.testing.assert_array_equal(smooth_surfaces(before, CENTERS, threads=3).points_in_world, plain.points_in_world)
    rotation = rotation_from_rotvec((0.3, -0.8, 0.5))
    turned = replace(
        before,
        points_in_world=(before.points_in_world @ rotation.T).astype(np.float32),
        normals_in_world=(before.normals_in_world @ rotation.T).astype(np.float32),
    )
    found = smooth_surfaces(turned, CENTERS @ rotation.T).points_in_world @ rotation
    # Cells lie differently, and of full ones not all points count.
    assert np.median(np.abs(found - plain.points_in_world)[:, 2]) < 0.005


def test_a_cloud_without_uncertainty_or_points_is_unchanged() -> None:
    known = noisy_wall(np.random.default_rng(5), noise=0.03, sigma=0.06, count=100)
    unknown = replace(known, uncertainty=None)
    assert smooth_surfaces(unknown, CENTERS) is unknown
    nothing = cloud_of(np.zeros((0, 3)), np.array([0.0, 0.0, -1.0]), 1.0)
    assert len(smooth_surfaces(nothing, CENTERS)) == 0
