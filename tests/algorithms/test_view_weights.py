"""Weights of sources: by the match around a pixel, carried over rounds, across the seam and the poles."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.patchmatch.refine import ViewWeights, refine_range
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render

SIZE = (12, 24)


def test_weights_are_the_matches_around_over_the_best_one() -> None:
    rng = np.random.default_rng(0)
    rounds = rng.uniform(-1, 1, (2, 3, *SIZE)).astype(np.float32)
    rounds[:, 2, :, :9] = -2  # does not count there
    weights = ViewWeights(3, SIZE)
    for correlations in rounds:
        weights.views[:] = correlations
        weights.update()
    match = np.where(rounds > -1.5, np.exp(-((1 - rounds) ** 2) / (2 * 0.3**2)), 0).mean(axis=0)
    padded = np.stack([pad_panorama(one, 2) for one in match])
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2)).mean(axis=(-1, -2))
    np.testing.assert_allclose(weights.views, (around / around.max(axis=0)) ** 2, rtol=1e-4, atol=1e-6)
    assert weights.known
    assert np.all(weights.views.max(axis=0) == 1)
    assert not weights.views[2, 3:-3, 3:6].any()  # away from the poles, where columns from across count


def test_where_no_source_counts_none_has_weight() -> None:
    weights = ViewWeights(2, SIZE)
    weights.views[:] = -2
    weights.update()
    assert not weights.views.any()


def test_a_source_that_shows_something_else_does_less_harm() -> None:
    """Two of three sources are turned by four pixels: the better half still contains one of them."""
    size = (96, 192)
    poses = capture_poses(4, seed=2, spread=0.3)
    pictures, truth = zip(*(render(default_room(), pose, size) for pose in poses), strict=True)
    spoilt = [pictures[1], *(np.roll(picture, 4, axis=1) for picture in pictures[2:])]
    off = np.float32(1) + np.random.default_rng(0).normal(0, 0.01, size).astype(np.float32)
    start = RangeMap(truth[0] * off, np.full(size, 100, np.uint8))

    def median_error(*, view_weights: bool) -> float:
        found = refine_range(
            start,
            pictures[0],
            spoilt,
            source_from_reference=[pose @ poses[0].inverse() for pose in poses[1:]],
            view_weights=view_weights,
        )
        return float(np.median(np.abs(found.range / truth[0] - 1)))

    assert median_error(view_weights=True) < 0.9 * median_error(view_weights=False)
