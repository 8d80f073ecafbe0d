"""Accuracy, completeness and F-score of clouds against true surfaces."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_evaluation.clouds import distances as measured_distances
from pano_mvs_evaluation.clouds.distances import CloudDistances, PointsInMemory, cloud_distances, score_cloud
from pano_mvs_evaluation.clouds.true_surface import TrueView, surface_of_cloud, surface_of_views, view_points

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, ray_grid
from tests.algorithms.range_scenes import box_range

SIZE = (128, 256)
HALF = np.array([3.0, 1.4, 2.5])
BOX_AREA = 8 * (HALF[0] * HALF[1] + HALF[1] * HALF[2] + HALF[2] * HALF[0])


def box_view(center: tuple[float, float, float], size_hw: tuple[int, int] = SIZE) -> TrueView:
    """A camera without rotation at a place in the empty box around the world's origin."""
    ranges, _ = box_range(size_hw, (HALF[0], HALF[1], HALF[2]), center)
    return TrueView(Rigid3.from_center(np.eye(3), center), ranges)


VIEWS = [box_view((0.4, -0.3, 0.2)), box_view((-0.5, 0.2, 0.6)), box_view((0.0, 0.1, -0.9))]


def distance_to_box(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """From points inside or near the walls of the box."""
    result: NDArray[np.float64] = np.abs(HALF - np.abs(points)).min(axis=1)
    return result


class TestSurface:
    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_areas_add_up_to_the_walls_however_many_views_see_them(self, count: int) -> None:
        surface = surface_of_views(VIEWS[:count])
        assert surface.area.sum() == pytest.approx(BOX_AREA, rel=0.01)
        assert distance_to_box(surface.points_in_world).max() < 1e-5

    def test_samples_may_be_few_and_still_stand_for_all(self) -> None:
        surface = surface_of_views(VIEWS, max_samples=3000)
        assert len(surface.area) <= 3000
        assert surface.area.sum() == pytest.approx(BOX_AREA, rel=0.05)

    def test_every_wall_counts_by_its_size_not_by_its_nearness(self) -> None:
        near = [box_view((2.6, 0, 0)), box_view((2.6, 0, 0.2))]
        surface = surface_of_views(near)
        wall = np.abs(surface.points_in_world[:, 0] - HALF[0]) < 1e-4
        assert wall.mean() > 0.25
        assert surface.area[wall].sum() == pytest.approx(4 * HALF[1] * HALF[2], rel=0.05)

    def test_what_one_view_alone_sees_need_not_be_found(self) -> None:
        ball = np.full(SIZE, 1.0, np.float32)
        hidden = ray_grid(SIZE)[..., 2] > 0.9
        views = [TrueView(Rigid3.identity(), ball), TrueView(Rigid3.identity(), np.where(hidden, np.nan, ball))]
        surface = surface_of_views(views)
        assert surface.points_in_world[:, 2].max() < 0.92
        assert set(np.unique(surface.view_idx)) == {0, 1}
        np.testing.assert_allclose(np.linalg.norm(surface.points_in_world, axis=1), 1, rtol=1e-6)

    def test_pixels_are_told_for_pictures(self) -> None:
        surface = surface_of_views(VIEWS)
        own = surface.view_idx == 1
        rays = ray_grid(SIZE).reshape(-1, 3)[surface.pixel_idx[own]]
        expected = VIEWS[1].range.reshape(-1)[surface.pixel_idx[own], None] * rays + VIEWS[1].cam_from_world.center
        np.testing.assert_allclose(surface.points_in_world[own], expected, atol=1e-5)

    def test_points_of_a_reference_cloud_share_their_voxel(self) -> None:
        points = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [1.5, 0.5, 0.5]], np.float32)
        np.testing.assert_array_equal(surface_of_cloud(points, voxel_size=1.0).area, [0.5, 0.5, 1])

    def test_no_view_is_named(self) -> None:
        with pytest.raises(UsageError, match="no view has ground truth"):
            surface_of_views([])


class TestScores:
    def test_the_truth_itself_is_perfect(self) -> None:
        points = np.concatenate([view_points(view) for view in VIEWS])
        surface = surface_of_views(VIEWS)
        scores = score_cloud(
            cloud_distances(PointsInMemory(points), map(view_points, VIEWS), surface, limit=0.5), surface, (0.2, 0.1)
        )
        assert scores[0].accuracy == scores[1].accuracy == 1
        assert scores[0].completeness > 0.99

    @pytest.mark.slow
    @pytest.mark.parametrize("off", [0.01, 0.03, 0.08])
    def test_a_cloud_that_lies_off_is_within_a_tolerance_that_allows_for_it(self, off: float) -> None:
        size = (256, 512)
        views = [box_view((0.4, -0.3, 0.2), size), box_view((-0.5, 0.2, 0.6), size)]
        walls = view_points(views[0])
        inwards = (walls * (1 - off / np.abs(walls).max(axis=1, keepdims=True))).astype(np.float32)
        surface = surface_of_views(views)
        tolerances = (off + 0.06, 0.5 * off)
        scores = score_cloud(cloud_distances(PointsInMemory(inwards), [walls], surface, limit=1), surface, tolerances)
        assert scores[0].accuracy == 1
        assert scores[1].accuracy < 0.1

    def test_half_a_cloud_is_half_complete_and_harmonic(self) -> None:
        surface = surface_of_views(VIEWS)
        points = np.concatenate([view_points(view) for view in VIEWS])
        half = points[points[:, 0] < 0]
        (score,) = score_cloud(cloud_distances(PointsInMemory(half), [points], surface, limit=0.2), surface, (0.1,))
        assert score.accuracy == 1
        assert score.completeness == pytest.approx(0.5, abs=0.03)
        assert score.f_score == pytest.approx(2 * score.completeness / (1 + score.completeness))

    def test_truth_in_pieces_is_the_truth(self) -> None:
        points = np.random.default_rng(3).normal(size=(200, 3)).astype(np.float32)
        surface = surface_of_views(VIEWS)
        pieces = [view_points(view) for view in VIEWS]
        whole = cloud_distances(PointsInMemory(points), [np.concatenate(pieces)], surface, limit=9)
        apart = cloud_distances(PointsInMemory(points), iter(pieces), surface, limit=9)
        np.testing.assert_array_equal(whole.of_points, apart.of_points)
        nearest = np.array([np.linalg.norm(np.concatenate(pieces) - point, axis=1).min() for point in points])
        np.testing.assert_allclose(whole.of_points, nearest, rtol=1e-5)

    @pytest.mark.slow
    def test_a_cloud_in_chunks_is_the_cloud(self, monkeypatch: pytest.MonkeyPatch) -> None:
        points = np.random.default_rng(3).normal(size=(900, 3)).astype(np.float32)
        surface, pieces = surface_of_views(VIEWS), [view_points(view) for view in VIEWS]
        whole = cloud_distances(PointsInMemory(points), pieces, surface, limit=9)
        monkeypatch.setattr(measured_distances, "CHUNK_POINTS", 100)

        class Uneven(PointsInMemory):
            def chunks(self) -> Iterator[NDArray[np.float32]]:
                return iter(np.split(self.positions, [7, 350, 350]))

        for chunks in (PointsInMemory(points), Uneven(points)):
            apart = cloud_distances(chunks, pieces, surface, limit=9)
            np.testing.assert_array_equal(whole.of_points, apart.of_points)
            np.testing.assert_array_equal(whole.of_surface, apart.of_surface)

    def test_quantiles_count_points_alike_and_the_surface_by_area(self) -> None:
        surface = surface_of_cloud(np.array([[0, 0, 0], [9, 9, 9]], np.float32), voxel_size=1)
        weighted = dataclasses.replace(surface, area=np.array([9.0, 1.0]))
        found = CloudDistances(np.array([1, 2, 3, np.inf], np.float32), np.array([5, 7], np.float32)).quantiles(
            weighted, (0.5, 0.9, 0.95)
        )
        assert found == {"accuracy": (2, np.inf, np.inf), "completeness": (5, 5, 7)}
        nothing = CloudDistances(np.zeros(0, np.float32), np.zeros(0, np.float32))
        assert np.isnan(nothing.quantiles(dataclasses.replace(surface, area=np.zeros(0)))["accuracy"]).all()

    def test_an_empty_cloud_scores_nothing_and_a_bad_limit_is_named(self) -> None:
        surface = surface_of_views(VIEWS)
        none = np.zeros((0, 3), np.float32)
        distances = cloud_distances(PointsInMemory(none), map(view_points, VIEWS), surface, limit=1)
        assert [(s.accuracy, s.completeness, s.f_score) for s in score_cloud(distances, surface)] == [(0, 0, 0)] * 2
        assert np.isinf(distances.of_surface).all()
        with pytest.raises(UsageError, match="must be positive"):
            cloud_distances(PointsInMemory(none), [], surface, limit=0)

    def test_a_distance_equal_to_the_tolerance_is_within_it(self) -> None:
        surface = surface_of_cloud(np.zeros((1, 3), np.float32), voxel_size=1)
        one = np.array([0.5], np.float32)
        assert score_cloud(CloudDistances(one, one), surface, (0.5,))[0].f_score == 1
        beside = PointsInMemory(np.array([[0.5, 0, 0]], np.float32))
        found = cloud_distances(beside, [surface.points_in_world], surface, limit=0.5)
        np.testing.assert_array_equal(found.of_points, one)
