from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view import estimate_two_view, verify_pair
from pano_mvs.algorithms.two_view.minimal_solvers import essential_from_bearings
from pano_mvs.algorithms.two_view.ransac import estimate_rotation
from pano_mvs.algorithms.two_view.redirection import best_redirected
from pano_mvs.algorithms.two_view.refinement import _linearised, pose_uncertainty, tangent_basis
from pano_mvs.algorithms.two_view.significance import independent_count, log10_false_alarms
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle, rotation_from_rotvec
from tests.algorithms.poses.synthetic_capture import (
    features_from_bearings,
    noisy_bearings,
    points_in_box,
    random_rotation,
    synthetic_matches,
)
from tests.oracles.two_view import in_front, moved_pose, poses_from_essential

HARD = {
    "along x": ((0.5, 0, 0), (0, 0, 0)),
    "straight up": ((0, -0.5, 0), (0, 0, 0)),
    "straight down": ((0, 0.4, 0), (0, 1.0, 0)),
    "forward": ((0, 0, 0.5), (0, 0, 0)),
    "backward over the seam": ((0.001, 0, -0.5), (0, np.pi, 0)),
    "half turn about x": ((0.3, 0.1, 0.2), (np.pi, 0, 0)),
    "half turn about z": ((0.3, 0.1, 0.2), (0, 0, np.pi)),
    "half turn about a slanted axis": ((0.3, -0.1, 0.2), tuple(np.pi / np.sqrt(3) * np.ones(3))),
    "short baseline": ((0.1, 0, 0.05), (0.2, 0.4, -0.3)),
}


def rng_of(name: str) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(name.encode()))


def draw(
    rng: np.random.Generator,
    center: Sequence[float],
    rotvec: Sequence[float],
    *,
    points: int = 400,
    noise_deg: float = 0.05,
    outliers: float = 0.3,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32], Rigid3]:
    pose = Rigid3.from_center(rotation_from_rotvec(rotvec), np.array(center))
    world = points_in_box(rng, points)
    p = noisy_bearings(rng, Rigid3.identity(), world, noise_deg=noise_deg)
    q = noisy_bearings(rng, pose, world, noise_deg=noise_deg)
    return p, q, synthetic_matches(rng, len(world), seen=1.0, outliers=outliers), pose


def errors_deg(rotation: NDArray[np.float64], direction: NDArray[np.float64], pose: Rigid3) -> tuple[float, float]:
    return (
        float(np.rad2deg(geodesic_angle(rotation, pose.rotation))),
        float(np.rad2deg(angle_between(direction, pose.translation))),
    )


@pytest.mark.parametrize("name", HARD)
def test_recovers_hard_poses_under_noise_and_outliers(name: str) -> None:
    rng = rng_of(name)
    p, q, matches, pose = draw(rng, *HARD[name])
    view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng)
    view.check()
    assert view.geometry == "general", view.reason
    rotation_deg, direction_deg = errors_deg(view.rotation, view.direction, pose)
    assert rotation_deg < 0.05
    assert direction_deg < 0.12 * 0.5 / np.linalg.norm(pose.translation)
    true = matches[:, 0] == matches[:, 1]
    assert len(view) > 0.9 * true.sum()
    assert (view.matches_idx[:, 0] == view.matches_idx[:, 1]).mean() > 0.97


@pytest.mark.parametrize("trial", range(4))
def test_recovers_where_three_quarters_of_the_matches_are_wrong(trial: int) -> None:
    """Eight true ones at once are met once in 65,000 draws; a nearly right rotation far sooner."""
    rng = rng_of(f"outliers {trial}")
    p, q, matches, pose = draw(rng, (0.4, -0.1, 0.3), (0.3, 1.0, -0.4), outliers=0.75)
    view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng, max_iterations=6000)
    assert view.geometry == "general", view.reason
    assert max(errors_deg(view.rotation, view.direction, pose)) < 0.4


def test_redirection_leaves_a_local_optimum() -> None:
    """Nearly the right rotation, and a direction that is far off."""
    rng = rng_of("redirected")
    p, q, matches, pose = draw(rng, (0.4, -0.1, 0.3), (0.3, 1.0, -0.4), outliers=0.6)
    wrong = Rigid3(rotation_from_rotvec([0.005, 0.005, -0.005]) @ pose.rotation, np.array([0.0, 1.0, 0.0]))
    found = best_redirected([wrong], p[matches[:, 0]], q[matches[:, 1]], rng=rng, threshold_rad=0.0035)
    assert max(errors_deg(found.rotation, found.translation, pose)) < 0.3


def test_exact_bearings_give_the_exact_pose() -> None:
    rng = rng_of("exact")
    p, q, _, pose = draw(rng, (0.3, -0.2, 0.4), (0.5, 2.0, -1.0), noise_deg=0.0)
    found = estimate_two_view(p, q, rng=rng, threshold_rad=1e-3)
    assert max(errors_deg(found.second_from_first.rotation, found.second_from_first.translation, pose)) < 1e-5
    assert found.inliers.all()


def test_turning_both_cameras_turns_the_result() -> None:
    rng = rng_of("turned")
    p, q, matches, _ = draw(rng, (0.4, 0.1, 0.2), (0.2, 0.3, 0.1))
    first_turn, second_turn = random_rotation(rng), random_rotation(rng)
    i, j = matches.T
    plain = estimate_two_view(p[i], q[j], rng=np.random.default_rng(1), threshold_rad=0.0035).second_from_first
    turned = estimate_two_view(
        p[i] @ first_turn.T, q[j] @ second_turn.T, rng=np.random.default_rng(1), threshold_rad=0.0035
    ).second_from_first
    expected = Rigid3(second_turn @ plain.rotation @ first_turn.T, second_turn @ plain.translation)
    assert max(errors_deg(turned.rotation, turned.translation, expected)) < 1e-3


def test_same_seed_same_bytes() -> None:
    p, q, matches, _ = draw(rng_of("bytes"), (0.4, 0.1, 0.2), (0.2, 0.3, 0.1))
    first, second = features_from_bearings(p), features_from_bearings(q)
    views = [verify_pair(first, second, matches, rng=np.random.default_rng(7)) for _ in range(2)]
    assert views[0].rotation.tobytes() == views[1].rotation.tobytes()
    assert views[0].matches_idx.tobytes() == views[1].matches_idx.tobytes()


@pytest.mark.parametrize(
    ("count", "crowd"),
    [
        *((count, crowd) for count in (40, 150, 600) for crowd in (0.0, 8.0)),
        pytest.param(3000, 8.0, marks=pytest.mark.slow),
    ],
)
def test_random_matches_have_no_geometry(count: int, crowd: float) -> None:
    """Also where key points crowd at the horizon, which makes chance agreement far more likely."""
    rng = rng_of(f"random {count} {crowd}")
    for _ in range(3):
        p, q = rng.normal(size=(2, count, 3)) / (1, 1 + crowd, 1)
        p, q = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (p, q))
        matches = np.stack([np.arange(count)] * 2, axis=1).astype(np.int32)
        view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng, max_iterations=3000)
        assert view.geometry == "none"
        assert not view
        assert view.reason


def test_one_crowded_detail_is_no_evidence() -> None:
    """A hundred key points on one detail of half a degree agree with many poses and prove none."""
    rng = rng_of("crowd")
    p = np.concatenate([rng.normal(size=(60, 3)), [0, 0, 1] + 0.004 * rng.normal(size=(100, 3))])
    q = np.concatenate([rng.normal(size=(60, 3)), [1, 0, 0] + 0.004 * rng.normal(size=(100, 3))])
    p, q = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (p, q))
    matches = np.stack([np.arange(160)] * 2, axis=1).astype(np.int32)
    view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng, max_iterations=3000)
    assert not view


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (0, np.pi, 0), (0.4, -1.0, 2.0)])
def test_pictures_from_one_place_are_a_rotation(rotvec: tuple[float, float, float]) -> None:
    rng = rng_of(f"rotation {rotvec}")
    p, q, matches, pose = draw(rng, (0, 0, 0), rotvec)
    view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng)
    assert view.geometry == "rotation"
    assert not view
    assert "same place" in view.reason
    assert np.rad2deg(geodesic_angle(view.rotation, pose.rotation)) < 0.03


def test_identical_pictures_are_a_rotation() -> None:
    p, _, _, _ = draw(rng_of("identical"), (0, 0, 0), (0, 0, 0))
    features = features_from_bearings(p)
    matches = np.stack([np.arange(len(p))] * 2, axis=1).astype(np.int32)
    view = verify_pair(features, features, matches, rng=np.random.default_rng(0))
    assert view.geometry == "rotation"
    assert (view.rotation_std_deg, view.direction_std_deg) == (0, 0)


def test_a_step_too_short_for_the_noise_is_no_baseline() -> None:
    rng = rng_of("short")
    p, q, matches, _ = draw(rng, (0.002, 0, 0.001), (0, 1, 0))
    view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng)
    assert view.geometry == "rotation"


def test_few_matches_are_refused_with_their_number() -> None:
    features = features_from_bearings(np.eye(3))
    view = verify_pair(features, features, np.zeros((3, 2), np.int32), rng=np.random.default_rng(0))
    assert not view
    assert view.reason == "3 matches, 16 needed"
    assert view.candidates == 3


def test_estimation_refuses_bad_shapes() -> None:
    with pytest.raises(UsageError, match="paired bearings"):
        estimate_two_view(np.zeros((4, 3)), np.zeros((5, 3)), rng=np.random.default_rng(0), threshold_rad=0.01)


def test_fewer_matches_than_two_samples_give_a_reason() -> None:
    found = estimate_two_view(np.eye(3), np.eye(3), rng=np.random.default_rng(0), threshold_rad=0.01)
    assert not found
    assert "only 3 matches" in found.reason


def test_linear_solution_and_its_four_decompositions() -> None:
    rng = rng_of("linear")
    p, q, _, pose = draw(rng, (0.3, 0.2, -0.4), (0.3, -2.0, 0.5), noise_deg=0.0)
    poses = poses_from_essential(essential_from_bearings(p, q))
    facing = [found for found in poses if in_front(p, q, found).all()]
    assert len(facing) == 1
    assert max(errors_deg(facing[0].rotation, facing[0].translation, pose)) < 1e-5
    for found in poses:
        assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_derivatives_of_the_sampson_error() -> None:
    rng = rng_of("derivatives")
    p, q, _, pose = draw(rng, (0.3, 0.2, -0.4), (0.3, -2.0, 0.5), noise_deg=2.0, points=50)
    pose = Rigid3(pose.rotation, pose.translation / np.linalg.norm(pose.translation))
    jacobian = _linearised(pose, p, q)[1]
    for column, step in enumerate(1e-6 * np.eye(5)):
        numeric = (_linearised(moved_pose(pose, step), p, q)[0] - _linearised(moved_pose(pose, -step), p, q)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, column], numeric, atol=1e-7)


def test_uncertainty_foretells_the_spread_of_errors() -> None:
    rng = rng_of("uncertainty")
    found = []
    for _ in range(30):
        p, q, _, pose = draw(rng, (0.5, 0, 0.1), (0, 0.5, 0), points=150, outliers=0.0)
        estimate = estimate_two_view(p, q, rng=rng, threshold_rad=0.006).second_from_first
        predicted = pose_uncertainty(estimate, p, q, noise_rad=np.deg2rad(0.05))
        found.append((geodesic_angle(estimate.rotation, pose.rotation), predicted[0]))
    actual, predicted = np.array(found).T
    assert 0.5 < np.sqrt(np.mean(actual**2)) / predicted.mean() < 2.0


def test_tangent_basis_is_orthonormal() -> None:
    directions = np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0]]])
    basis = tangent_basis(directions)
    np.testing.assert_allclose(np.swapaxes(basis, 1, 2) @ basis, np.tile(np.eye(2), (7, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.einsum("nij,ni->nj", basis, directions), 0, atol=1e-12)


def test_rotation_alone_is_recovered() -> None:
    rng = rng_of("alone")
    p, q, matches, pose = draw(rng, (0, 0, 0), (1.0, 2.0, 0.5))
    rotation, agreeing = estimate_rotation(p[matches[:, 0]], q[matches[:, 1]], rng=rng, threshold_rad=0.004)
    assert np.rad2deg(geodesic_angle(rotation, pose.rotation)) < 0.02
    assert agreeing.mean() > 0.65


def test_false_alarms_fall_with_inliers_and_rise_with_chance() -> None:
    def alarms(k: int, p: float) -> float:
        return log10_false_alarms(k, 100, chance=p, sample=8)

    assert alarms(60, 0.01) < alarms(30, 0.01) < alarms(30, 0.1)
    assert alarms(8, 0.01) > 0
    assert alarms(12, 0.1) > 0


def test_crowds_count_once() -> None:
    crowd = np.tile([0.0, 0.0, 1.0], (50, 1))
    assert independent_count(crowd, crowd) == 1
    assert independent_count(np.eye(3), np.eye(3)) == 3
