"""Pictures of places that repeat, from key points to verified poses: no camera is wrong without being reported."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.algorithms.two_view import verify_pair
from tests.synthetic.scenes import Scene
from tools.benchmarks.poses.placements import judge_placements
from tools.benchmarks.repeating.places import colonnade, tiled_hall

SIZE_HW = (256, 512)
WHOLE = np.ones(SIZE_HW, np.bool_)
VIEWS = 6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "seed", "fewest_right", "most_silent"), [(tiled_hall, 1, VIEWS - 1, 0), (colonnade, 3, 4, 2)]
)
def test_few_cameras_are_wrong_and_unreported(
    place: Callable[..., Scene], seed: int, fewest_right: int, most_silent: int
) -> None:
    """By the pairs alone, the colonnade falls into three pairs of cameras. The images join them, the last one wrong.

    The true arrangement is confirmed more, by .65 a camera instead of .50, but no seed leads to it. The images refute
    other places of single cameras, but nothing compares the last two at another place together, so that these are wrong
    in silence.
    """
    scene = place(seed=seed, unique=0.6, layout="path", views=VIEWS)
    pictures = {f"{idx}.png": scene.view(idx, SIZE_HW, supersample=1)[0] for idx in range(VIEWS)}
    truth = dict(zip(pictures, scene.poses, strict=True))
    features = {name: extract_sift(picture, WHOLE) for name, picture in pictures.items()}
    rng = np.random.default_rng(1)
    two_views = {
        (a, b): verify_pair(features[a], features[b], match_features(features[a], features[b]), rng=rng)
        for a, b in combinations(features, 2)
    }

    def load(name: str) -> Picture:
        return pictures[name], WHOLE

    best_only = {pair: view.with_alternatives([]) for pair, view in two_views.items()}
    misled = judge_placements(solve_scaled_translation(features, best_only, rng=rng), truth)
    assert misled.right.sum() < VIEWS - 1  # or the place is too easy
    solved = solve_scaled_translation(features, two_views, load=load, rng=rng)
    placed = judge_placements(verify_poses(solved, load, features=features, two_views=two_views), truth)
    assert len(placed.unreported) <= most_silent
    assert placed.right.sum() >= fewest_right
