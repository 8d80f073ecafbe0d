"""The pose solver where the best geometry of some pairs is false; without pictures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.geometry import Rigid3
from pano_mvs.geometry.pose_errors import relative_pose_errors
from pano_mvs.scene import Poses, TwoView
from tests.algorithms.poses.aliased_capture import AliasedCapture, aliased_capture
from tools.benchmarks.poses.placements import judge_placements

# Image 3 stands a tile further along by three of its five pairs; one more pair is false.
FALSE = {(0, 3): 1, (1, 3): 1, (2, 3): 1, (0, 2): -1}
# The pairs of image 5 put it in five places.
CONTRADICTED = {(0, 5): 1, (1, 5): -2, (2, 5): 3, (3, 5): -4, (4, 5): 5}


def solve(capture: AliasedCapture, two_views: dict[tuple[str, str], TwoView] | None = None, **settings: Any) -> Poses:
    return solve_scaled_translation(
        capture.features, two_views or capture.two_views, rng=np.random.default_rng(0), **settings
    )


def cameras(poses: Poses) -> dict[str, Rigid3]:
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}


@pytest.fixture(scope="module")
def capture() -> AliasedCapture:
    return aliased_capture("solver", false=FALSE)


@pytest.mark.slow
@pytest.mark.parametrize("adjust", [False, True])
def test_all_cameras_are_right_although_many_pairs_are_false(capture: AliasedCapture, adjust: bool) -> None:
    poses = solve(capture, adjust=adjust)
    poses.check()
    placed = judge_placements(poses, capture.poses)
    assert poses.rejected == {}
    assert placed.names == capture.names
    assert placed.right.all()


def test_the_best_geometries_alone_would_misplace_or_lose_a_camera(capture: AliasedCapture) -> None:
    """So that the test above is one of alternatives."""
    placed = judge_placements(solve(capture, capture.best_only()), capture.poses)
    assert len(placed.names) < 6 or not placed.right.all()


def test_the_same_bytes_again(capture: AliasedCapture) -> None:
    first, second = (solve(capture) for _ in range(2))
    assert first.rotations.tobytes() == second.rotations.tobytes()
    assert first.translations.tobytes() == second.translations.tobytes()
    assert first.points_in_world.tobytes() == second.points_in_world.tobytes()


@pytest.mark.slow
def test_the_order_of_the_capture_does_not_matter(capture: AliasedCapture) -> None:
    """Nor does which image of a pair comes first."""
    rng = np.random.default_rng(1)
    names = [capture.names[idx] for idx in rng.permutation(6)]
    pairs = [list(capture.two_views)[idx] for idx in rng.permutation(len(capture.two_views))]
    shuffled = AliasedCapture(
        capture.poses,
        {name: capture.features[name] for name in names},
        {pair: capture.two_views[pair] for pair in pairs},
    )
    poses = solve(shuffled)
    assert poses.names == tuple(names)
    assert relative_pose_errors(cameras(poses), cameras(solve(capture))).pair_deg.max() < 0.05


def test_a_false_seed_is_not_taken_for_its_many_matches() -> None:
    """The pair with most matches and the widest parallax is false, and all others support its runner-up."""
    capture = aliased_capture("seed", false={(0, 1): -1})
    most = max(capture.two_views, key=lambda pair: len(capture.two_views[pair]))
    assert most == capture.names[:2]
    assert judge_placements(solve(capture), capture.poses).right.all()


def test_every_group_is_solved_with_its_alternatives() -> None:
    """Two captures that no pair connects, the second with false pairs."""
    large = aliased_capture("large group", false={(0, 2): 1, (1, 4): -1}, views=5)
    small = aliased_capture("small group", false={(1, 2): 1}, views=4)
    rename = {name: f"small-{name}" for name in small.names}
    both = AliasedCapture(
        large.poses | {rename[name]: pose for name, pose in small.poses.items()},
        large.features | {rename[name]: found for name, found in small.features.items()},
        large.two_views | {(rename[a], rename[b]): view for (a, b), view in small.two_views.items()},
    )
    poses = solve(both)
    assert poses.rejected == {}
    assert poses.group_idx is not None
    assert poses.group_idx.tolist() == [0] * 5 + [1] * 4
    placed = judge_placements(poses, both.poses)
    assert len(placed.names) == 9
    assert placed.right.all()


def test_an_image_whose_geometries_are_all_false_is_rejected_with_a_reason() -> None:
    """Neither the best geometries of its pairs nor their runner-ups see points where the others know them to be."""
    capture = aliased_capture("lost", false=CONTRADICTED)
    rng = np.random.default_rng(5)
    two_views = dict(capture.two_views)
    for pair, view in capture.two_views.items():
        if "5.jpg" in pair:
            runner_up = [_scrambled(other, rng, count=40) for other in view.alternatives]
            two_views[pair] = _scrambled(view, rng, count=60).with_alternatives(runner_up)
    poses = solve(capture, two_views)
    assert poses.names == capture.names[:5]
    assert set(poses.rejected) == {"5.jpg"}
    assert "points" in poses.rejected["5.jpg"]
    assert judge_placements(poses, {name: capture.poses[name] for name in poses.names}).right.all()


def _scrambled(view: TwoView, rng: np.random.Generator, *, count: int) -> TwoView:
    """Return a geometry with a few of its matches, which are wrong."""
    matches = view.matches_idx[rng.permutation(len(view))[:count]]
    wrong = np.stack([matches[:, 0], rng.permutation(matches[:, 1])], axis=1)
    return replace(view, matches_idx=wrong, residuals_rad=view.residuals_rad[:count])


def test_an_image_whose_pairs_contradict_one_another_has_a_rival_and_is_the_least_probable() -> None:
    """Its five pairs put it in five places, and none of them has the truth; only images could decide."""
    capture = aliased_capture("contradicted", false=CONTRADICTED, with_truth=False)
    poses = solve(capture)
    assert (judge_placements(poses, capture.poses).right == (np.array(poses.names) != "5.jpg")).all()
    assert (poses.evidence["5.jpg"]["place_rival"] or 0) > 0.9
    assert poses.right_probabilities is not None
    assert poses.names[np.argmin(poses.right_probabilities)] == "5.jpg"


def test_a_camera_whose_pairs_agree_on_a_false_place_is_the_one_thing_that_matches_cannot_tell() -> None:
    """Whoever is shifted by all pairs alike stands there; the points in the room then decide if there are any."""
    shifted = {(image, 5): 1 for image in range(5)}
    capture = aliased_capture("all alike", false=shifted, with_truth=False)
    placed = judge_placements(solve(capture), capture.poses)
    assert placed.right[:5].all()
    assert not placed.right[5:].any()
