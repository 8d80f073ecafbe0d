"""Surfaces of a cloud become thin, where their uncertainty allows it, and nothing else moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.fusion.smooth import smooth_surfaces, surface_heights
from pano_mvs.geometry import rotation_from_rotvec
from pano_mvs.scene import PointCloud
from tests.oracles import smoothing as oracle

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


def wall(rng: np.random.Generator, *, noise: float, sigma: float, count: int = 4000) -> PointCloud:
    """Return a noisy wall at z = 3, 2 × 2 in size."""
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


def test_a_noisy_wall_becomes_thin() -> None:
    before = wall(np.random.default_rng(0), noise=0.03, sigma=0.06)
    after = smooth_surfaces(before, CENTERS)
    inner = np.abs(before.points_in_world[:, :2]).max(axis=1) < 0.8
    thickness = [float(cloud.points_in_world[inner, 2].std()) for cloud in (before, after)]
    assert thickness[1] < 0.4 * thickness[0]
    assert abs(after.points_in_world[inner, 2].mean() - 3) < 0.006


def test_no_point_moves_by_more_than_its_uncertainty() -> None:
    before = wall(np.random.default_rng(1), noise=0.03, sigma=0.02)
    moves = np.linalg.norm(smooth_surfaces(before, CENTERS).points_in_world - before.points_in_world, axis=1)
    assert 0.01 < moves.max() < 0.0201


def test_two_surfaces_farther_apart_than_their_uncertainty_stay_apart() -> None:
    rng = np.random.default_rng(2)
    first, second = (wall(rng, noise=0.003, sigma=0.01, count=3000) for _ in range(2))
    points = np.concatenate([first.points_in_world, second.points_in_world + np.array([0, 0, 0.1])])
    both = cloud_of(points, np.array([0.0, 0.0, -1.0]), 0.01)
    after = smooth_surfaces(both, CENTERS).points_in_world[:, 2]
    np.testing.assert_allclose([after[:3000].mean(), after[3000:].mean()], [3, 3.1], atol=0.001)


def test_the_frame_and_the_number_of_threads_do_not_matter() -> None:
    before = wall(np.random.default_rng(4), noise=0.03, sigma=0.06, count=600)
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
    known = wall(np.random.default_rng(5), noise=0.03, sigma=0.06, count=100)
    unknown = replace(known, uncertainty=None)
    assert smooth_surfaces(unknown, CENTERS) is unknown
    nothing = cloud_of(np.zeros((0, 3)), np.array([0.0, 0.0, -1.0]), 1.0)
    assert len(smooth_surfaces(nothing, CENTERS)) == 0
