"""Depth metrics: both protocols, the weights, and what a constant scores."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pixel_solid_angle
from tests.algorithms.range_scenes import box_range
from tests.benchmarks.depth_metrics import constant_baseline, depth_metrics

SIZE = (16, 32)


def test_the_truth_scores_perfectly() -> None:
    truth, _ = box_range(SIZE)
    truth[3, 4] = np.inf
    metrics = depth_metrics(truth / 2, truth, scale=2.0)
    assert metrics.pixels == 511
    assert metrics.mse == 0
    assert metrics.psnr_db == np.inf
    assert metrics.completeness == metrics.w_completeness == metrics.delta_105 == metrics.valid_w_delta_105 == 1
    assert metrics.bad_5 == metrics.median_relative_error == 0


def test_figures_of_a_uniform_error() -> None:
    truth = np.full(SIZE, 2.0)
    metrics = depth_metrics(np.full(SIZE, 2.2), truth)
    assert metrics.mae == pytest.approx(0.2)
    assert metrics.rmse == pytest.approx(0.2)
    assert metrics.mse == pytest.approx(4e-4)
    assert metrics.psnr_db == pytest.approx(-10 * np.log10(4e-4))
    assert metrics.abs_rel == pytest.approx(0.1)
    assert (metrics.delta_105, metrics.delta_125, metrics.bad_5) == (0, 1, 1)
    assert metrics.w_mae == pytest.approx(0.2)


def test_a_missing_pixel_is_an_error_equal_to_the_truth_in_one_protocol_and_nothing_in_the_other() -> None:
    truth = np.full(SIZE, 3.0)
    estimated = truth.copy()
    estimated[:, :8] = np.nan
    metrics = depth_metrics(estimated, truth)
    assert metrics.completeness == pytest.approx(0.75)
    assert metrics.mae == pytest.approx(0.75)
    assert metrics.abs_rel == pytest.approx(0.25)
    assert metrics.delta_105 == pytest.approx(0.75)
    assert metrics.bad_5 == pytest.approx(0.25)
    assert metrics.valid_mae == metrics.valid_mse == 0
    assert metrics.valid_w_delta_105 == 1


def test_weights_are_solid_angles() -> None:
    truth = np.full(SIZE, 2.0)
    estimated = truth.copy()
    estimated[0] = 3.0
    share = pixel_solid_angle(SIZE)[0] * SIZE[1] / (4 * np.pi)
    metrics = depth_metrics(estimated, truth)
    assert metrics.mae == pytest.approx(1 / 16)
    assert metrics.w_mae == pytest.approx(share)
    assert metrics.w_delta_105 == pytest.approx(1 - share)
    assert metrics.w_rmse == pytest.approx(np.sqrt(share))


def test_sky_and_masked_pixels_are_left_out() -> None:
    truth, _ = box_range(SIZE)
    broken, mask = truth.copy(), np.ones(SIZE, bool)
    broken[:4], mask[:4] = 99, False
    assert depth_metrics(broken, truth, mask=mask).mae == 0
    truth[:2], truth[2:4] = np.inf, np.nan
    assert depth_metrics(broken, truth).mae == 0
    assert depth_metrics(broken, truth).pixels == 12 * 32


def test_a_constant_scores_what_its_definition_says() -> None:
    truth, _ = box_range(SIZE)
    truth[0] = np.inf
    expected = depth_metrics(np.full(SIZE, np.median(truth[1:])), truth)
    assert constant_baseline(truth) == expected
    assert 10 < expected.psnr_db < 30


def test_nothing_to_count_is_not_a_number() -> None:
    metrics = depth_metrics(np.ones(SIZE), np.full(SIZE, np.inf))
    assert metrics.pixels == 0
    assert np.isnan(metrics.mae)
    assert np.isnan(metrics.median_relative_error)
    assert np.isnan(constant_baseline(np.full(SIZE, np.nan)).psnr_db)
    nothing = depth_metrics(np.full(SIZE, np.nan), np.ones(SIZE))
    assert nothing.completeness == 0
    assert nothing.mae == 1
    assert np.isnan(nothing.valid_mae)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"scale": 0}, "scale .* must be positive"),
        ({"peak": -1}, "peak must be a positive"),
        ({"mask": np.ones((2, 2), bool)}, "one size"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        depth_metrics(np.ones(SIZE), np.ones(SIZE), **settings)
