"""Sparsification: the order that confidence gives against the order of the errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_evaluation.capture import score_capture
from pano_mvs_evaluation.ranges.view_scores import Sparsification, scored_pixels
from pano_mvs_evaluation.ranges.view_scores import sparsify as sparsify_pixels

from pano_mvs.geometry import Rigid3

SIZE = (16, 32)


def sparsify(
    estimated: NDArray[np.float64], confidence: NDArray[np.integer], truth: NDArray[np.float64], scale: float = 1.0
) -> Sparsification:
    return sparsify_pixels(scored_pixels(estimated, truth, confidence=confidence, scale=scale))


def noisy(seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64], np.random.Generator]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(1, 4, SIZE)
    return truth, truth * (1 + rng.normal(0, 0.1, SIZE)), rng


def ranks(values: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.argsort(np.argsort(values.ravel())).reshape(values.shape)


def test_confidence_in_the_order_of_the_errors_is_as_good_as_can_be() -> None:
    truth, estimated, _ = noisy()
    error = np.abs(estimated - truth) / truth
    best, worst = (sparsify(estimated, ranks(order), truth) for order in (-error, error))
    assert best.ause == pytest.approx(0, abs=1e-12)
    alike = sparsify(estimated, np.zeros(SIZE, np.uint8), truth)
    assert worst.ause > 2 * alike.ause > 0
    assert (best.unranked_area, worst.unranked_area) == pytest.approx((alike.area, alike.area))


def test_coarse_confidence_has_the_area_of_a_random_order_within_each_level() -> None:
    truth, estimated, rng = noisy()
    coarse = ranks(-np.abs(estimated - truth) / truth) // 100
    drawn = [
        sparsify(estimated, coarse * 1000 + rng.permutation(SIZE[0] * SIZE[1]).reshape(SIZE) % 1000, truth).area
        for _ in range(20)
    ]
    assert sparsify(estimated, coarse, truth).area == pytest.approx(np.mean(drawn), rel=0.02)


def test_pixels_without_truth_or_estimate_do_not_count_and_scale_does() -> None:
    truth, estimated, rng = noisy()
    confidence = rng.integers(1, 255, SIZE)
    expected = sparsify(estimated[:, :16], confidence[:, :16], truth[:, :16])
    truth[:, 16:24], estimated[:, 24:] = np.inf, np.nan
    found = sparsify(estimated / 3, confidence, truth, scale=3.0)
    assert (found.area, found.ause) == pytest.approx((expected.area, expected.ause))
    assert np.isnan(sparsify(np.full(SIZE, np.nan), confidence, truth)).all()


def test_scores_of_a_capture_tell_how_confidence_ranks_if_it_is_given() -> None:
    truth, estimated, rng = noisy()
    confidence = rng.integers(1, 255, SIZE).astype(np.uint8)
    poses = {name: Rigid3(np.eye(3), np.array([x, 0.0, 0.0])) for name, x in (("a", 0.0), ("b", 1.0))}
    maps: dict[str, Any] = {
        "estimated_ranges": {"a": estimated.astype(np.float32)},
        "true_ranges": {"a": lambda: truth.astype(np.float32)},
    }
    told = score_capture(poses, poses, **maps, confidences={"a": confidence}).views["a"]
    assert told["ause"] == pytest.approx(sparsify(estimated, confidence, truth).ause, rel=1e-3)
    assert told["ause"] == pytest.approx(told["sparsification_area"] - told["sparsification_oracle_area"])
    assert "ause" not in score_capture(poses, poses, **maps).views["a"]
