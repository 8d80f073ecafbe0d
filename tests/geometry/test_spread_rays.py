"""Fibonacci's spiral spreads rays evenly: what is averaged over them is the mean over the sphere."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.geometry import spiral_rays


@pytest.mark.parametrize("count", [1, 2, 100, 1000])
def test_rays_are_of_unit_length(count: int) -> None:
    rays = spiral_rays(count)
    assert rays.shape == (count, 3)
    assert np.linalg.norm(rays, axis=1) == pytest.approx(np.ones(count))


def test_every_band_between_two_heights_has_its_share() -> None:
    heights = spiral_rays(1000)[:, 1]
    shares, _ = np.histogram(heights, 10, (-1, 1))
    assert shares.tolist() == [100] * 10
    assert heights[0] == pytest.approx(0.999)


def test_no_direction_is_preferred() -> None:
    rays = spiral_rays(1000)
    assert rays.mean(axis=0) == pytest.approx(np.zeros(3), abs=2e-3)
    assert rays.T @ rays / 1000 == pytest.approx(np.eye(3) / 3, abs=5e-3)


def test_neighbours_are_about_as_far_apart_as_on_a_lattice_of_triangles() -> None:
    rays = spiral_rays(500)
    cosines = rays @ rays.T
    np.fill_diagonal(cosines, -1)
    nearest = np.arccos(cosines.max(axis=1))
    on_a_lattice = np.sqrt(8 * np.pi / (np.sqrt(3) * 500))
    assert nearest.min() > 0.7 * on_a_lattice
    assert nearest.max() < 1.1 * on_a_lattice
