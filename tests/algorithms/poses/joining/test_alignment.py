"""Poses from three points, and errors of matches between models."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.joining.cross_matches import CrossMatches, errors_and_residuals, match_errors, vector_of
from pano_mvs.algorithms.poses.joining.three_points import candidate_poses, poses_from_three
from pano_mvs.geometry import Rigid3, Similarity3, angle_between, geodesic_angle, rotation_from_rotvec


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def test_three_points_determine_the_pose() -> None:
    rng = np.random.default_rng(3)
    pose = Rigid3(rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3))
    points = 3 * rng.normal(size=(50, 3, 3))
    bearings = _unit(points @ pose.rotation.T + pose.translation)
    rotations, translations = poses_from_three(points, bearings)
    errors = np.abs(rotations - pose.rotation).max(axis=(1, 2)) + np.abs(translations - pose.translation).max(axis=1)
    assert (errors < 1e-4).sum() >= 49
    seen = np.einsum("kij,kj->ki", rotations, points[0, :1].repeat(len(rotations), 0)) + translations
    assert np.isfinite(seen).all()


def test_three_points_on_one_spot_give_no_pose() -> None:
    points = np.ones((4, 3, 3))
    assert len(poses_from_three(points, _unit(points))[0]) == 0


def test_finds_the_pose_among_mostly_false_matches() -> None:
    rng = np.random.default_rng(5)
    pose = Rigid3(rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3))
    points = 3 * rng.normal(size=(120, 3))
    bearings = _unit(pose.apply(points))
    bearings[24:] = bearings[24:][rng.permutation(96)]
    best = candidate_poses(points, bearings, rng=rng, threshold_rad=0.005)[0]
    assert float(geodesic_angle(best.rotation, pose.rotation)) < 1e-3
    assert float(np.linalg.norm(best.center - pose.center)) < 0.01
    assert candidate_poses(points[:5], bearings[:5], rng=rng, threshold_rad=0.005) == []


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


def test_swapped_matches_have_the_same_errors() -> None:
    similarity, matches = _drawn()
    there, back = match_errors(similarity, matches), match_errors(similarity.inverse(), matches.swapped())
    np.testing.assert_allclose(there, back, rtol=1e-6, atol=1e-9)
