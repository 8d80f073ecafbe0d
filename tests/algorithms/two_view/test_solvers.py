"""Minimal solvers: what they solve, and that one plane is no obstacle to the five-point one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view import estimate_two_view, verify_pair
from pano_mvs.algorithms.two_view.cheirality import facing_costs, facing_pose
from pano_mvs.algorithms.two_view.minimal_solvers import (
    SOLVERS,
    Solver,
    draw_samples,
    essentials_from_five,
    samples_needed,
)
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, skew
from tests.algorithms.poses.synthetic_capture import (
    features_from_bearings,
    noisy_bearings,
    random_rotation,
    synthetic_matches,
)
from tests.algorithms.two_view.test_two_view import HARD, draw, errors_deg, rng_of
from tests.oracles.two_view import sampson_angles


def samples_of_five(
    rng: np.random.Generator, *, count: int, flat: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], Rigid3]:
    """Exact bearings of five points each, all on one plane if flat, and the true essential matrix of norm √2."""
    pose = Rigid3.from_center(random_rotation(rng), rng.normal(size=3))
    points = 2 * rng.normal(size=(count, 5, 3))
    if flat:
        points[..., 2] = 1.0
    moved = pose.apply(points.reshape(-1, 3)).reshape(points.shape)
    p, q = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (points, moved))
    essential = skew(pose.translation / np.linalg.norm(pose.translation)) @ pose.rotation
    return p, q, essential, pose


def wall_seen_twice(
    trial: object, *, noise_deg: float = 0.02
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32], Rigid3]:
    """A picture wall and nothing else, two fifths of the matches wrong."""
    rng = rng_of(f"wall {trial}")
    pose = Rigid3.from_center(random_rotation(rng), np.array([0.5, -0.2, 0.3]))
    wall = rng.uniform(-1.5, 1.5, size=(600, 3))
    wall[:, 2] = 2.0
    p = noisy_bearings(rng, Rigid3.identity(), wall, noise_deg=noise_deg)
    q = noisy_bearings(rng, pose, wall, noise_deg=noise_deg)
    return p, q, synthetic_matches(rng, len(wall), seen=1.0, outliers=0.4), pose


@pytest.mark.parametrize("flat", [False, True])
def test_five_points_give_the_true_matrix_among_others(flat: bool) -> None:
    p, q, essential, _ = samples_of_five(rng_of(f"five {flat}"), count=200, flat=flat)
    found, sample_idx = essentials_from_five(p, q)
    distance = np.minimum(*(np.linalg.norm(found - sign * essential, axis=(1, 2)) for sign in (1, -1)))
    nearest = np.full(len(p), np.inf)
    np.minimum.at(nearest, sample_idx, distance)
    assert nearest.max() < 1e-6
    assert np.median(nearest) < 1e-11
    assert np.bincount(sample_idx).max() <= 10


def test_every_solution_is_an_essential_matrix_that_all_five_pairs_obey() -> None:
    p, q, _, _ = samples_of_five(rng_of("obey"), count=100, flat=False)
    found, sample_idx = essentials_from_five(p, q)
    left_over = np.einsum("kmi,kij,kmj->km", q[sample_idx], found, p[sample_idx])
    np.testing.assert_allclose(left_over, 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.svd(found)[1], np.tile([1, 1, 0], (len(found), 1)), atol=1e-6)


def test_turning_the_cameras_turns_the_solutions() -> None:
    rng = rng_of("turned solutions")
    p, q, _, _ = samples_of_five(rng, count=1, flat=False)
    first, second = random_rotation(rng), random_rotation(rng)
    plain, turned = essentials_from_five(p, q)[0], essentials_from_five(p @ first.T, q @ second.T)[0]
    expected = second @ plain @ first.T
    assert len(turned) == len(plain)
    for matrix in expected:
        assert min(np.linalg.norm(turned - s * matrix, axis=(1, 2)).min() for s in (1, -1)) < 1e-6


def test_samples_without_a_solution_give_none() -> None:
    p = np.tile([0.0, 0.0, 1.0], (2, 5, 1))
    found, sample_idx = essentials_from_five(p, p)
    assert np.isfinite(found).all()
    assert len(found) == len(sample_idx)


def test_a_wall_defeats_eight_points_and_not_five() -> None:
    """Many matrices fit a plane in the linear equations; the ten cubic ones leave two, and one is behind a camera."""
    errors: dict[Solver, list[float]] = {solver: [] for solver in SOLVERS}
    for trial in range(3):
        p, q, matches, pose = wall_seen_twice(trial)
        for solver in SOLVERS:
            found = estimate_two_view(
                p[matches[:, 0]], q[matches[:, 1]], rng=rng_of("wall"), threshold_rad=0.0035, solver=solver
            ).second_from_first
            errors[solver].append(max(errors_deg(found.rotation, found.translation, pose)))
    assert max(errors["five_point"]) < 0.3
    assert np.median(errors["eight_point"]) > 5


def test_what_lies_behind_tells_the_two_matrices_of_a_plane_apart() -> None:
    p, q, _, pose = samples_of_five(rng_of("twins"), count=40, flat=True)
    flat_p, flat_q = p.reshape(-1, 3), q.reshape(-1, 3)
    found, _ = essentials_from_five(p[:1], q[:1])
    fitting = [e for e in found if sampson_angles(e, flat_p, flat_q).max() < 1e-6]
    assert len(fitting) == 2
    poses = [facing_pose(e, flat_p, flat_q, threshold_rad=0.0035) for e in fitting]
    costs = facing_costs(poses, flat_p, flat_q, threshold_rad=0.0035)
    best = poses[int(np.argmin(costs))]
    assert max(errors_deg(best.rotation, best.translation, pose)) < 1e-3
    assert costs.min() < 1e-3
    assert costs.max() > 10


@pytest.mark.parametrize("name", ["along x", "straight up", "backward over the seam", "half turn about a slanted axis"])
def test_eight_points_recover_hard_poses_too(name: str) -> None:
    rng = rng_of(name)
    p, q, matches, pose = draw(rng, *HARD[name])
    first, second = features_from_bearings(p), features_from_bearings(q)
    view = verify_pair(first, second, matches, rng=rng, solver="eight_point")
    assert view.geometry == "general", view.reason
    assert max(errors_deg(view.rotation, view.direction, pose)) < 0.15


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_minimal_model_as_it_comes_is_right_but_coarse(solver: Solver) -> None:
    coarse: list[float] = []
    fine: list[float] = []
    for trial in range(3):
        rng = rng_of(f"coarse {trial}")
        p, q, matches, pose = draw(rng, (0.5, 0, 0.1), (0, 0.5, 0))
        first, second = features_from_bearings(p), features_from_bearings(q)
        for errors, refine in ((coarse, False), (fine, True)):
            view = verify_pair(first, second, matches, rng=rng_of("seed"), solver=solver, refine=refine)
            assert view.geometry == "general", view.reason
            errors.append(max(errors_deg(view.rotation, view.direction, pose)))
    assert max(coarse) < 5
    assert np.mean(coarse) > 3 * np.mean(fine)


def test_exact_bearings_need_no_refinement() -> None:
    rng = rng_of("exact minimal")
    p, q, _, pose = draw(rng, (0.3, -0.2, 0.4), (0.5, 2.0, -1.0), noise_deg=0.0)
    for solver in SOLVERS:
        found = estimate_two_view(p, q, rng=rng, threshold_rad=1e-3, solver=solver, refine=False).second_from_first
        assert max(errors_deg(found.rotation, found.translation, pose)) < 1e-4


def test_a_pair_tells_how_well_it_is_determined() -> None:
    """What the record foretells is as large as the errors, and grows as the baseline shrinks."""
    actual: list[tuple[float, float]] = []
    foretold: dict[float, list[tuple[float, float]]] = {0.5: [], 0.1: []}
    for trial in range(10):
        for length, found in foretold.items():
            rng = rng_of(f"determined {trial}")
            p, q, matches, pose = draw(rng, (length, 0, 0), (0, 0.5, 0))
            view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng)
            found.append((view.rotation_std_deg, view.direction_std_deg))
            if length == 0.5:
                actual.append(errors_deg(view.rotation, view.direction, pose))
    ratio = np.sqrt(np.mean(np.square(actual), axis=0)) / np.mean(foretold[0.5], axis=0)
    assert np.all(ratio > 0.4)
    assert np.all(ratio < 2.0)
    assert np.mean(foretold[0.1], axis=0)[1] > 3 * np.mean(foretold[0.5], axis=0)[1]


def test_samples_hold_distinct_matches() -> None:
    samples = draw_samples(rng_of("samples"), 9, batch=500, sample=8)
    assert samples.shape == (500, 8)
    assert all(len(set(row)) == 8 for row in samples)
    assert set(samples.ravel()) == set(range(9))


def test_smaller_samples_are_needed_fewer_times() -> None:
    assert samples_needed(0.5, 0.9999, sample=5) < samples_needed(0.5, 0.9999, sample=8) / 7
    assert samples_needed(1.0, 0.9999, sample=5) == 0
    assert samples_needed(0.0, 0.9999, sample=5) == np.inf


def test_an_unknown_solver_is_named() -> None:
    p, q, _, _ = draw(rng_of("unknown"), (0.5, 0, 0), (0, 0, 0))
    unknown: Any = "six"
    with pytest.raises(UsageError, match=r"no solver 'six'; choose one of five_point, eight_point"):
        estimate_two_view(p, q, rng=rng_of("unknown"), threshold_rad=0.01, solver=unknown)
