"""The compiled parts of fusion equal their plain counterparts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.fusion.kernels_fuse import add_source, find_supported
from pano_mvs.algorithms.panoramas import columns_per_step
from pano_mvs.geometry import Rigid3, ray_grid, rotation_from_rotvec, sines_of_grid
from tests.oracles import fusion as oracle

SIZE, SOURCE_SIZE = (12, 24), (10, 20)
LIMITS = np.array([0.05, 0.2, 0.05, 1.05, 0.03, 100.0])
FIELDS = ("yields", "counts", "violations", "confidence", "sums", "colors", "precisions")


def rough_sphere(rng: np.random.Generator, size_hw: tuple[int, int]) -> np.ndarray:
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
    ranges, source_ranges = rough_sphere(rng, SIZE), rough_sphere(rng, SOURCE_SIZE)
    rays = ray_grid(SIZE)
    normals = -rays + rng.normal(0, 0.5, rays.shape)
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    written = rng.random(SIZE) < 0.8
    confidence = rng.integers(30, 200, SOURCE_SIZE).astype(np.uint8)
    image = rng.integers(0, 256, (*SOURCE_SIZE, 3)).astype(np.uint8)
    pose = Rigid3(rotation_from_rotvec((0.4, -1.9, 0.7)), np.array([0.05, -0.03, 0.06]))
    uncertainty = rng.uniform(0.01, 0.2, SOURCE_SIZE if with_uncertainty else (0, 0)).astype(np.float32)
    found: dict[str, NDArray[Any]] = {
        "yields": np.zeros(SIZE, np.bool_),
        "counts": np.zeros(SIZE, np.uint8),
        "violations": np.zeros(SIZE, np.uint8),
        "confidence": np.zeros(SIZE, np.uint8),
        "sums": np.zeros((*SIZE, 4)),
        "colors": np.zeros((*SIZE, 4)),
        "precisions": np.zeros(SIZE if with_uncertainty else (0, 0)),
    }
    source = (np.array(pose.rotation), np.array(pose.translation), source_ranges, confidence, image, uncertainty)
    for rows in ((0, 5), (5, 12)):
        add_source(
            (ranges, sines_of_grid(SIZE), normals, written), source, LIMITS, rows, tuple(found[name] for name in FIELDS)
        )
    expected = oracle.add_source(
        (ranges, rays, normals, written), pose, (source_ranges, confidence, image, uncertainty), LIMITS
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
    ranges = rough_sphere(rng, SIZE)
    confirmed = np.isfinite(ranges) & (rng.random(SIZE) < 0.6)
    stretches = columns_per_step(SIZE, steps=5)
    assert stretches.max() > 1
    found = find_supported(ranges, confirmed, stretches, 2, 0.03, least)
    expected = oracle.supported(ranges, confirmed, stretches, radius=2, max_step=0.03, least=least)
    np.testing.assert_array_equal(found, expected)
    assert 0 < found.sum() < (np.isfinite(ranges) & ~confirmed).sum()
