"""Errors of matches between models."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.joining.cross_matches import CrossMatches, errors_and_residuals, match_errors, vector_of
from pano_mvs.geometry import Similarity3, angle_between, rotation_from_rotvec


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _drawn(count: int = 60) -> tuple[Similarity3, CrossMatches]:
    rng = np.random.default_rng(8)
    similarity = Similarity3(1.7, rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3))
    centers = rng.normal(size=(count, 2, 3))
    second = 4 * rng.normal(size=(count, 3))
    offsets = np.stack([similarity.apply(second) - centers[:, 0], second - centers[:, 1]], axis=1)
    rays = _unit(offsets + rng.normal(0, 0.02, offsets.shape))
    ranges = np.linalg.norm(offsets, axis=2)
    ranges[::3, 0] = np.nan
    ranges[::4, 1] = np.nan
    numbers = np.zeros((count, 2), np.int32)
    return similarity, CrossMatches(numbers.astype(np.intp), numbers, centers, rays, ranges)


def _plain_error(similarity: Similarity3, matches: CrossMatches, idx: int) -> float:
    """The errors of one match, as the docstring states them."""
    (c, d), (u, v), (r, s) = matches.centers[idx], matches.rays[idx], matches.ranges[idx]
    angles = []
    if np.isfinite(r):
        angles.append(float(angle_between(similarity.inverse().apply((c + r * u)[None])[0] - d, v)))
    if np.isfinite(s):
        angles.append(float(angle_between(similarity.apply((d + s * v)[None])[0] - c, u)))
    if angles:
        return max(angles)
    baseline, turned = _unit(similarity.apply(d[None])[0] - c), similarity.rotation @ v
    e = float(np.cross(u, turned) @ baseline)
    squares = np.sum(np.cross(baseline, u) ** 2) + np.sum(np.cross(baseline, turned) ** 2) - 2 * e**2
    return float(abs(e) / np.sqrt(squares))


@pytest.mark.kernel("poses.joining.kernels_alignment")
def test_errors_are_those_of_plain_geometry() -> None:
    similarity, matches = _drawn()
    plain = np.array([_plain_error(similarity, matches, idx) for idx in range(len(matches))])
    assert np.isnan(matches.ranges).all(axis=1).any()
    np.testing.assert_allclose(match_errors(similarity, matches), plain, rtol=1e-6, atol=1e-9)
    errors, residuals = errors_and_residuals(vector_of(similarity), matches)
    unknown = np.isnan(matches.ranges)
    assert (residuals[unknown[:, 0], :3] == 0).all()
    assert (residuals[unknown[:, 1], 3:6] == 0).all()
    alone = unknown.all(axis=1)
    np.testing.assert_allclose(np.abs(residuals[alone, 6]), errors[alone])
