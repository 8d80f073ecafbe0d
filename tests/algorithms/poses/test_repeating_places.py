"""Pictures of places that repeat, from key points to verified poses: no camera is wrong without being reported."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
import pytest

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.algorithms.two_view import verify_pair
from tools.benchmarks.poses.placements import judge_placements
from tools.benchmarks.repeating.places import tiled_hall

SIZE_HW, SMALL_HW = (256, 512), (96, 192)
WHOLE = np.ones(SIZE_HW, np.bool_)
VIEWS = 5


@pytest.mark.slow
def test_the_images_place_cameras_that_the_pairs_alone_misplace() -> None:
    scene = tiled_hall(seed=1, unique=0.6, layout="path", views=VIEWS)
    pictures = {f"{idx}.png": scene.view(idx, SIZE_HW, supersample=1)[0] for idx in range(VIEWS)}
    truth = dict(zip(pictures, scene.poses, strict=True))
    features = {name: extract_sift(picture, WHOLE) for name, picture in pictures.items()}
    rng = np.random.default_rng(1)
    two_views = {
        (a, b): verify_pair(features[a], features[b], match_features(features[a], features[b]), rng=rng)
        for a, b in combinations(features, 2)
    }

    def load(name: str) -> Picture:
        """Return a smaller picture than that of the key points: the sweeps take most of the time."""
        small = cv2.resize(pictures[name], SMALL_HW[::-1], interpolation=cv2.INTER_AREA)
        return small.astype(np.uint8), np.ones(SMALL_HW, np.bool_)

    best_only = {pair: view.with_alternatives([]) for pair, view in two_views.items()}
    misled = judge_placements(solve_scaled_translation(features, best_only, rng=rng), truth)
    assert misled.right.sum() < VIEWS - 1  # or the place is too easy
    solved = solve_scaled_translation(features, two_views, load=load, rng=rng)
    placed = judge_placements(verify_poses(solved, load, features=features, two_views=two_views), truth)
    assert len(placed.unreported) == 0
    assert placed.right.sum() == VIEWS
