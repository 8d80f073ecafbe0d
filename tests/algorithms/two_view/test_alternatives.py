"""Runner-up geometries: found where structure repeats, and only there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.algorithms.two_view.alternatives import distinct_geometries
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import TwoView
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings
from tests.algorithms.two_view.test_solvers import wall_seen_twice
from tests.algorithms.two_view.test_two_view import HARD, draw, errors_deg, rng_of

TILE = 0.6


def tiled_hall(
    name: str, *, tiles: int = 260, others: int = 110, wrong: int = 60, noise_deg: float = 0.04
) -> tuple[NDArray[np.float64], NDArray[np.float64], Rigid3, Rigid3]:
    """A floor whose matches are all shifted by one tile, a smaller true structure, and wrong matches.

    Returns rays of both pictures, n matching n, the true pose, and the one that the floor feigns: the same rotation,
    with the second camera one tile further.
    """
    rng = rng_of(name)
    pose = Rigid3.from_center(rotation_from_rotvec([0.2, 1.1, -0.3]), np.array([0.5, 0.1, 0.9]))
    floor = np.stack([rng.uniform(-4, 4, tiles), np.full(tiles, 1.4), rng.uniform(-4, 4, tiles)], axis=1)
    furniture = rng.uniform(-1, 1, size=(others, 3)) * [4, 1.2, 4]
    furniture = furniture[np.linalg.norm(furniture - [0.25, 0, 0.45], axis=1) > 1.0]
    elsewhere = rng.normal(size=(2, wrong, 3))
    shift = np.array([TILE, 0.0, 0.0])
    p = [noisy_bearings(rng, Rigid3.identity(), points, noise_deg=noise_deg) for points in (floor, furniture)]
    q = [noisy_bearings(rng, pose, points, noise_deg=noise_deg) for points in (floor + shift, furniture)]
    first, second = (
        np.concatenate([*seen, noise / np.linalg.norm(noise, axis=1, keepdims=True)])
        for seen, noise in zip((p, q), elsewhere, strict=True)
    )
    feigned = Rigid3(pose.rotation, pose.apply(shift[None])[0])
    return first, second, pose, feigned


def all_matches(count: int) -> NDArray[np.int32]:
    return np.stack([np.arange(count)] * 2, axis=1).astype(np.int32)


def verified(p: NDArray[np.float64], q: NDArray[np.float64], seed: str = "alternatives", **settings: Any) -> TwoView:
    return verify_pair(
        features_from_bearings(p), features_from_bearings(q), all_matches(len(p)), rng=rng_of(seed), **settings
    )


def nearest_deg(view: TwoView, pose: Rigid3) -> tuple[float, int]:
    """How far the nearest of all geometries is from a pose, and how many matches support it."""
    return min((max(errors_deg(one.rotation, one.direction, pose)), len(one)) for one in (view, *view.alternatives))


@pytest.mark.parametrize("trial", range(4))
def test_the_truth_comes_out_beside_what_repeated_tiles_feign(trial: int) -> None:
    p, q, pose, feigned = tiled_hall(f"tiled {trial}")
    view = verified(p, q)
    view.check()
    assert max(errors_deg(view.rotation, view.direction, feigned)) < 0.3
    error_deg, support = nearest_deg(view, pose)
    assert error_deg < 0.5
    assert support > 80
    sizes = [len(one) for one in view.alternatives]
    assert sizes == sorted(sizes, reverse=True)
    for one in view.alternatives:
        one.check()
        assert one.geometry == "general"
        assert (one.residuals_rad < np.deg2rad(0.2)).all()


def test_a_minority_with_another_rotation_is_found_too() -> None:
    """Two rooms alike: a third of the matches tell of another pose altogether."""
    rng = rng_of("twin rooms")
    p, q, _, pose = draw(rng, (0.4, 0.1, 0.2), (0.2, 0.3, 0.1), points=300)
    r, s, _, other = draw(rng, (-0.3, 0.0, 0.5), (0.1, -2.0, 0.4), points=150)
    view = verified(np.concatenate([p, r]), np.concatenate([q, s]))
    assert max(errors_deg(view.rotation, view.direction, pose)) < 0.2
    assert len(view.alternatives) == 1
    assert nearest_deg(view, other)[0] < 0.4


@pytest.mark.parametrize("name", HARD)
def test_without_repetition_there_is_no_alternative(name: str) -> None:
    for trial in range(3):
        rng = rng_of(f"{name} {trial}")
        p, q, matches, _ = draw(rng, *HARD[name], outliers=0.4)
        view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng)
        assert view
        assert not view.alternatives


def test_a_wall_alone_has_no_alternative() -> None:
    """The matches of a plane fit two poses; but the second explains no match that the first does not."""
    p, q, matches, _ = wall_seen_twice(0)
    view = verify_pair(features_from_bearings(p), features_from_bearings(q), matches, rng=rng_of("wall alone"))
    assert view
    assert not view.alternatives


def test_the_reversed_pair_has_the_inverse_geometries() -> None:
    p, q, pose, feigned = tiled_hall("reversed")
    there, back = verified(p, q), verified(q, p)
    for expected in (pose, feigned):
        assert nearest_deg(there, expected)[0] < 0.5
        inverse = expected.inverse()
        assert nearest_deg(back, inverse)[0] < 0.5
    assert len(there.alternatives) == len(back.alternatives)


def test_the_order_of_matches_does_not_matter() -> None:
    p, q, pose, feigned = tiled_hall("order")
    order = rng_of("shuffle").permutation(len(p))
    for view in (verified(p, q), verified(p[order], q[order])):
        assert nearest_deg(view, pose)[0] < 0.5
        assert nearest_deg(view, feigned)[0] < 0.5


def test_same_seed_gives_the_same_alternatives() -> None:
    p, q, _, _ = tiled_hall("repeated")
    views = [verified(p, q) for _ in range(2)]
    assert len(views[0].alternatives) == len(views[1].alternatives) > 0
    for one, other in zip(views[0].alternatives, views[1].alternatives, strict=True):
        assert one.rotation.tobytes() == other.rotation.tobytes()
        assert one.matches_idx.tobytes() == other.matches_idx.tobytes()


def test_no_alternatives_on_request_nor_without_refinement() -> None:
    p, q, _, _ = tiled_hall("settings")
    assert verified(p, q).alternatives
    assert not verified(p, q, max_alternatives=0).alternatives
    assert not verified(p, q, refine=False).alternatives
    best = verified(p, q, max_alternatives=0)
    assert best.rotation.tobytes() == verified(p, q).rotation.tobytes()


@pytest.mark.parametrize("trial", range(3))
def test_what_many_wrong_matches_agree_on_by_chance_is_no_alternative(trial: int) -> None:
    """Of 1500 wrong matches between key points near the horizon a few dozen agree with some pose."""
    rng = rng_of(f"horizon {trial}")
    p, q, _, pose = draw(rng, (0.4, 0.1, 0.2), (0.0, 0.3, 0.0), points=120, outliers=0.0)
    best = Rigid3(pose.rotation, pose.translation / np.linalg.norm(pose.translation))
    wrong = rng.normal(size=(2, 1500, 3)) / (1, 6, 1)
    wrong /= np.linalg.norm(wrong, axis=2, keepdims=True)
    first, second = np.concatenate([p, wrong[0]]), np.concatenate([q, wrong[1]])
    found = distinct_geometries(
        best, first, second, rng=rng, threshold_rad=float(np.deg2rad(0.2)), min_inliers=20, most=4
    )
    assert len(found) == 1
    assert max(errors_deg(found[0].rotation, found[0].translation, pose)) < 0.5
