"""The compiled parts of two-view estimation equal their plain counterparts in numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.cheirality import agreement, facing_costs, facing_pose, least_essentials
from pano_mvs.algorithms.two_view.minimal_solvers import essentials_from_five
from pano_mvs.algorithms.two_view.ransac import estimate_rotation
from pano_mvs.algorithms.two_view.redirection import direction_candidates
from pano_mvs.algorithms.two_view.refinement import refine_relative_pose
from pano_mvs.algorithms.two_view.significance import chance_of_pose
from pano_mvs.geometry import Rigid3, geodesic_angle, rotation_from_rotvec, skew
from tests.algorithms.poses.synthetic_capture import random_rotation
from tests.algorithms.two_view.test_solvers import samples_of_five
from tests.algorithms.two_view.test_two_view import draw, errors_deg, rng_of
from tests.oracles import two_view as plain
from tests.oracles.two_view import essentials_by_eigenvectors

THRESHOLD_RAD = 0.0035


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return result


def paired(
    name: str, *, points: int = 150, noise_deg: float = 0.05
) -> tuple[NDArray[np.float64], NDArray[np.float64], Rigid3, np.random.Generator]:
    """Matched rays, a third of them wrong and some at the end so far away that they only turn; and the pose."""
    rng = rng_of(name)
    p, q, matches, pose = draw(rng, (0.4, -0.1, 0.3), (0.3, 1.0, -0.4), points=points, noise_deg=noise_deg)
    pose = Rigid3(pose.rotation, unit(pose.translation))
    far = unit(rng.normal(size=(20, 3)))
    far_seen = unit(far @ pose.rotation.T + np.deg2rad(noise_deg) * rng.normal(size=far.shape))
    return np.concatenate([p[matches[:, 0]], far]), np.concatenate([q[matches[:, 1]], far_seen]), pose, rng


@pytest.mark.kernel("two_view.kernels_five_point")
@pytest.mark.parametrize("flat", [False, True])
def test_five_point_kernel_finds_what_the_oracle_finds(flat: bool) -> None:
    p, q, _, _ = samples_of_five(rng_of(f"five kernel {flat}"), count=60, flat=flat)
    found, sample_idx = essentials_from_five(p, q)
    expected, expected_idx = essentials_by_eigenvectors(p, q)
    assert abs(len(found) - len(expected)) <= 2  # two roots that all but coincide are one's rounding from none
    missing = 0
    for matrix, idx in zip(expected, expected_idx, strict=True):
        of_sample = found[sample_idx == idx]
        distance = min((np.linalg.norm(of_sample - s * matrix, axis=(1, 2)).min() for s in (1, -1)), default=np.inf)
        missing += distance > 1e-5
    assert missing <= 2


@pytest.mark.kernel("two_view.kernels_five_point")
def test_five_point_kernel_takes_any_memory_layout() -> None:
    p, q, _, _ = samples_of_five(rng_of("kernel layout"), count=4, flat=False)
    twisted = (np.asfortranarray(p), np.asfortranarray(q))
    np.testing.assert_array_equal(essentials_from_five(*twisted)[0], essentials_from_five(p, q)[0])


@pytest.mark.kernel("two_view.kernels_agreement")
def test_agreement_kernel_equals_the_oracle() -> None:
    p, q, pose, _ = paired("agreement")
    for candidate in (pose, Rigid3(pose.rotation, -pose.translation)):
        residuals, agreeing = agreement(candidate, p, q, threshold_rad=THRESHOLD_RAD)
        expected = plain.agreement(candidate, p, q, THRESHOLD_RAD)
        np.testing.assert_allclose(residuals, expected[0], atol=1e-12)
        np.testing.assert_array_equal(agreeing, expected[1])
    assert agreeing[-20:].any()  # what is far away agrees with either sign


@pytest.mark.kernel("two_view.kernels_agreement")
def test_facing_kernels_equal_the_oracle() -> None:
    p, q, pose, rng = paired("facing kernels")
    poses = [pose, Rigid3(pose.rotation, -pose.translation), Rigid3(random_rotation(rng), pose.translation)]
    np.testing.assert_allclose(
        facing_costs(poses, p, q, threshold_rad=THRESHOLD_RAD),
        plain.facing_costs(poses, p, q, THRESHOLD_RAD),
        atol=1e-6,
    )
    for expected in (pose, poses[2]):
        essential = skew(expected.translation) @ expected.rotation
        found = facing_pose(-3 * essential, p, q, threshold_rad=THRESHOLD_RAD)
        oracle = plain.facing_pose(essential, p, q, THRESHOLD_RAD)
        assert max(errors_deg(found.rotation, found.translation, oracle)) < 1e-5
    found = facing_pose(skew(pose.translation) @ pose.rotation, p, q, threshold_rad=THRESHOLD_RAD)
    assert max(errors_deg(found.rotation, found.translation, pose)) < 1e-5


@pytest.mark.kernel("two_view.kernels_agreement")
def test_ranking_kernel_keeps_the_order_of_plain_costs() -> None:
    p, q, pose, rng = paired("ranking kernel", points=600)
    turns = [rotation_from_rotvec(scale * rng.normal(size=3)) for scale in np.geomspace(1e-4, 0.1, 40)]
    essentials = rng.permutation(np.array([skew(pose.translation) @ turn @ pose.rotation for turn in turns]))
    costs = plain.msac_costs(essentials, p, q, THRESHOLD_RAD)
    expected = essentials[np.argsort(costs)[:5]]
    order = rng.permutation(len(p))
    for sigmas in (3.0, np.inf):
        found = least_essentials(essentials, p[order], q[order], threshold_rad=THRESHOLD_RAD, sigmas=sigmas, count=5)
        np.testing.assert_array_equal(found, expected)
    limit = np.sort(costs)[:3].mean()
    few = least_essentials(essentials, p, q, threshold_rad=THRESHOLD_RAD, limit=limit, sigmas=np.inf, count=5)
    np.testing.assert_array_equal(few, expected[: int((costs < limit).sum())])


@pytest.mark.kernel("two_view.kernels_refinement")
@pytest.mark.parametrize("iterations", [1, 4, 20])
def test_refinement_kernel_takes_the_steps_of_the_oracle(iterations: int) -> None:
    p, q, pose, rng = paired("refinement kernel", noise_deg=0.1)
    start = Rigid3(
        rotation_from_rotvec([0.01, -0.02, 0.01]) @ pose.rotation, unit(pose.translation + 0.05 * rng.normal(size=3))
    )
    settings: dict[str, Any] = {"scale_rad": 0.01, "max_iterations": iterations}
    found, expected = refine_relative_pose(start, p, q, **settings), plain.refine_relative_pose(start, p, q, **settings)
    assert max(errors_deg(found.rotation, found.translation, expected)) < 1e-4
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    assert np.rad2deg(geodesic_angle(start.rotation, found.rotation)) > 0.1


@pytest.mark.kernel("two_view.kernels_refinement")
def test_refinement_kernel_leaves_its_input_alone() -> None:
    p, q, pose, _ = paired("input")
    rotation, translation = pose.rotation.copy(), pose.translation.copy()
    refine_relative_pose(pose, p, q, scale_rad=0.01)
    np.testing.assert_array_equal(pose.rotation, rotation)
    np.testing.assert_array_equal(pose.translation, translation)


@pytest.mark.kernel("two_view.kernels_agreement")
def test_kernel_costs_of_directions_are_those_of_plain_poses() -> None:
    p, q, pose, rng = paired("directions kernel")
    directions, costs = direction_candidates(pose.rotation, p, q, rng=rng, threshold_rad=THRESHOLD_RAD, count=30)
    both = [
        plain.facing_costs([Rigid3(pose.rotation, sign * d) for d in directions], p, q, THRESHOLD_RAD)
        for sign in (1, -1)
    ]
    np.testing.assert_allclose(costs, both[0], atol=1e-6)
    assert np.all(both[0] <= both[1] + 1e-6)


@pytest.mark.kernel("two_view.kernels_agreement")
def test_kernel_counts_chance_as_plain_numpy_does() -> None:
    p, q, pose, _ = paired("chance kernel")
    found = chance_of_pose(pose, p, q, rng=rng_of("pairs"), threshold_rad=0.02, draws=3000)
    pairs = rng_of("pairs").integers(len(p), size=(3000, 2))
    first, second = (rays[column] for rays, column in zip((p, q), pairs[pairs[:, 0] != pairs[:, 1]].T, strict=True))
    near = plain.agreement(pose, first, second, 0.02)[0] < 0.02
    expected = int((near & plain.in_front(first, second, pose)).sum())
    assert expected > 10
    assert found == pytest.approx((expected + 1) / (len(first) + 1))


@pytest.mark.kernel("two_view.kernels_agreement")
def test_turning_kernel_passes_over_a_match_drawn_twice() -> None:
    """The same match twice determines no turn; and of two matches a few pairs of draws are such."""
    rng = rng_of("twice kernel")
    turn, p = random_rotation(rng), unit(rng.normal(size=(2, 3)))
    rotation, agreeing = estimate_rotation(p, p @ turn.T, rng=rng, threshold_rad=0.01)
    assert geodesic_angle(rotation, turn) < 1e-6
    assert agreeing.all()
