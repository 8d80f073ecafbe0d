"""The benchmarks of uncertainty and of walls measure what they say."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.uncertainty import coverage, halved_truth
from tests.benchmarks.walls import completeness, thicknesses


def test_errors_of_a_normal_distribution_are_covered_as_expected() -> None:
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.01, 0.1, 20_000)
    shares = coverage(np.abs(rng.normal(0, sigma)), sigma, np.ones(20_000))
    np.testing.assert_allclose(shares, [0.683, 0.954, 0.997], atol=0.01)


def test_a_halved_plane_is_the_plane_and_edges_do_not_mix() -> None:
    inverse = np.broadcast_to(np.linspace(0.2, 0.4, 40), (20, 40))
    halved = halved_truth((1 / inverse).astype(np.float32))
    np.testing.assert_allclose(1 / halved[0], inverse[0].reshape(-1, 2).mean(axis=1), rtol=1e-5)
    edge = np.where(np.arange(40) < 21, 2.0, 4.0) * np.ones((20, 1))
    assert set(np.unique(halved_truth(edge.astype(np.float32)))) == {2.0, 4.0}


def test_the_thickness_of_a_slab_is_its_deviation() -> None:
    rng = np.random.default_rng(0)
    slab = np.column_stack([rng.uniform(-3, 3, (4000, 2)), rng.normal(0, 0.02, 4000)])
    assert abs(np.median(thicknesses(slab, 0.5)) - 0.02) < 0.002


def test_half_a_sphere_is_half_complete() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60_000, 3))
    upper = points[points[:, 1] > 0]
    assert abs(completeness(points, np.zeros((1, 3))) - 1) < 0.01
    assert abs(completeness(upper, np.zeros((1, 3))) - 0.5) < 0.01
