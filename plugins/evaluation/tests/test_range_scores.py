"""Scores of range maps against their definitions, on the sphere, and beside the best constants.

Range maps at another size: exact on planes, nothing between two surfaces.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pano_mvs_evaluation.ranges.pairs import resized_labels, resized_range
from pano_mvs_evaluation.ranges.view_scores import (
    DELTAS,
    PROTOCOLS,
    BadLimit,
    ScoreSettings,
    ViewScores,
    aligning_scale,
    best_constant_errors,
    best_constant_median,
    mean_scores,
    range_errors,
    score_view,
    scored_pixels,
    weighted_median,
    weighted_quantile,
)
from scipy.optimize import minimize_scalar

from pano_mvs.core.errors import UsageError
from tests.algorithms.range_scenes import box_range
from tests.oracles import surfaces as oracle

SIZE = (6, 12)
BAD = (BadLimit(0.05), BadLimit(0.5), BadLimit(1.5), BadLimit(0.3, relative=False))
NAMES = ["mse", "psnr_db", "rmse", "mae", "abs_rel", *DELTAS, *(limit.name for limit in BAD)]
HARD = [np.nan, np.inf, -np.inf, 0.0, -1.0]


def draw(
    seed: int, size_hw: tuple[int, int] = SIZE, hard: float = 0.3
) -> tuple[NDArray[np.float64], NDArray[np.float64], np.random.Generator]:
    """An estimate and a truth with all that can be wrong in them."""
    rng = np.random.default_rng(seed)
    truth = rng.choice(np.array([1.0, 2.0, 2.0 * 1.05**2, 3.0, *rng.uniform(0.1, 9, 6)]), size_hw)
    estimated = truth * rng.choice(np.array([1.0, 1.04, 0.8, 1.25, 3.0, 0.2]), size_hw)
    for array in (estimated, truth):
        where = rng.random(size_hw) < hard
        array[where] = rng.choice(HARD, where.sum())
    return estimated, truth, rng


class TestDefinitions:
    @given(st.integers(0, 10**6), st.sampled_from([0.5, 1.0, 2.5]), st.sampled_from([0.0, 0.3, 0.9]))
    @settings(max_examples=15, deadline=None)
    def test_every_score_is_what_its_definition_says(self, seed: int, scale: float, hard: float) -> None:
        estimated, truth, _ = draw(seed, hard=hard)
        found = score_view(estimated, truth, scale=scale, settings=ScoreSettings(peak=7.0, bad=BAD)).scores
        for prefix in PROTOCOLS:
            for name in NAMES:
                expected = oracle.score(prefix + name, estimated, truth, peak=7.0, scale=scale)
                assert found[prefix + name] == pytest.approx(expected, rel=1e-9, nan_ok=True), prefix + name
        for name in ("completeness", "w_completeness"):
            assert found[name] == pytest.approx(oracle.score(name, estimated, truth, scale=scale), nan_ok=True)

    @pytest.mark.parametrize("value", [2.2, *HARD])
    def test_a_single_pixel(self, value: float) -> None:
        found = score_view(np.array([[value]]), np.array([[2.0]])).scores
        known = value == 2.2
        assert found["mae"] == found["w_mae"] == pytest.approx(0.2 if known else 2.0)
        assert (found["completeness"], found["delta_125"], found["bad_5"]) == (known, known, 1)
        assert np.isnan(found["valid_mae"]) != known
        assert np.isnan(found["median_relative_error"]) != known

    def test_no_pixel_at_all_is_no_number_and_no_error(self) -> None:
        found = score_view(np.ones(SIZE), np.full(SIZE, np.nan), confidence=np.full(SIZE, 9, np.uint8))
        assert found.pixels == 0
        assert all(np.isnan(value) for value in found.scores.values())
        assert all(np.isnan(value) for constant in found.constants.values() for value in constant.values())

    def test_confidence_below_what_is_asked_is_no_estimate(self) -> None:
        truth = np.full(SIZE, 2.0)
        estimated, confidence = truth.copy(), np.full(SIZE, 200, np.uint8)
        estimated[:3], confidence[:3] = 9.0, 100
        found = score_view(estimated, truth, confidence=confidence, settings=ScoreSettings(min_confidence=128)).scores
        assert (found["completeness"], found["valid_mae"], found["mae"]) == (0.5, 0, 1)
        assert found["ause"] == pytest.approx(0, abs=1e-12)
        assert score_view(estimated, truth, confidence=confidence).scores["completeness"] == 1

    @pytest.mark.parametrize(
        ("settings", "words"),
        [
            ({"settings": ScoreSettings(min_confidence=1)}, "there is no confidence"),
            ({"confidence": np.zeros((2, 2), np.uint8)}, "must be .* of one size"),
            ({"scale": np.nan}, "must be positive"),
        ],
    )
    def test_what_cannot_be_judged_is_told(self, settings: dict[str, Any], words: str) -> None:
        with pytest.raises(UsageError, match=words):
            score_view(np.ones(SIZE), np.ones(SIZE), **settings)

    @pytest.mark.parametrize("text", ["", "5 percent", "0", "-1%", "nan", "inf"])
    def test_limits_that_are_none_are_told(self, text: str) -> None:
        with pytest.raises(UsageError, match="is not a limit for bad pixels"):
            BadLimit.from_text(text)

    def test_limits_are_named_by_what_they_are(self) -> None:
        assert [BadLimit.from_text(text).name for text in ("5%", "2.5 %", "0.1")] == ["bad_5", "bad_2.5", "bad_abs_0.1"]


class TestSphere:
    """An error only above 60° of latitude: its share of the sphere is (1 − sin 60°) / 2, of the picture a sixth."""

    SIZE = (180, 360)
    SHARE = (1 - np.sin(np.deg2rad(60))) / 2

    def scores(self) -> ViewScores:
        truth = np.full(self.SIZE, 2.0)
        estimated = truth.copy()
        estimated[:30] *= 1.5
        confidence = np.full(self.SIZE, 200, np.uint8)
        confidence[:30] = 50
        return score_view(estimated, truth, confidence=confidence)

    def test_weighted_scores_are_shares_of_the_sphere(self) -> None:
        found = self.scores().scores
        assert found["mae"] == pytest.approx(1 / 6)
        assert found["w_mae"] == pytest.approx(self.SHARE)
        assert found["w_abs_rel"] == pytest.approx(self.SHARE / 2)
        assert found["w_rmse"] == pytest.approx(np.sqrt(self.SHARE))
        assert found["w_delta_125"] == pytest.approx(1 - self.SHARE)
        assert found["bad_5"] == pytest.approx(1 / 6)
        assert found["w_bad_5"] == pytest.approx(self.SHARE)

    def test_completeness_and_medians_are_too(self) -> None:
        truth = np.full(self.SIZE, 2.0)
        estimated = truth.copy()
        estimated[:30] = np.nan
        assert score_view(estimated, truth).scores["w_completeness"] == pytest.approx(1 - self.SHARE)
        rows = np.broadcast_to(np.arange(self.SIZE[0])[:, None], self.SIZE)
        median = score_view(truth * (1 + rows / 1000), truth).scores["w_median_relative_error"]
        assert median == pytest.approx(0.089, abs=0.002)  # half the sphere lies above the equator

    def test_a_confidence_that_knows_the_error_has_no_area_but_an_unranked_one(self) -> None:
        found = self.scores()
        assert found.scores["ause"] == pytest.approx(0, abs=1e-9)
        # unranked: the mean error; ranked: that error's share of what is kept beyond the sure ones
        share = self.SHARE
        oracle_area = 0.5 * (share - (1 - share) * -np.log(1 - share))
        expected = 0.5 * share - oracle_area
        assert found.constants["best"]["ause"] == pytest.approx(expected, rel=1e-6)
        assert found.constants["best"]["plain_ause"] > found.constants["best"]["ause"]


class TestBestConstant:
    @pytest.mark.parametrize(("seed", "weighted"), [(0, False), (1, True), (2, False), (3, True)])
    def test_no_constant_found_by_search_is_better_and_one_is_as_good(self, seed: int, weighted: bool) -> None:
        rng = np.random.default_rng(seed)
        true = rng.choice([rng.uniform(1, 5, 40), rng.lognormal(0.5, 0.6, 40), np.repeat(rng.uniform(1, 3, 5), 8)])
        weight = rng.uniform(0.1, 2, 40) if weighted else np.ones(40)
        best = best_constant_errors(true, weight, bad=BAD)
        # every score changes its slope or jumps only near these
        places = np.concatenate([true * factor for factor in (1, 1.05, 1.25, 1.25**2, 1.25**3, 0.5, 1.5, 2.5, 0.95)])
        tried = np.unique(np.concatenate([places, 1 / places * 2, true + 0.3, true - 0.3, np.linspace(0.2, 12, 100)]))
        tried = np.concatenate([tried * factor for factor in (1 - 1e-9, 1, 1 + 1e-9)])
        tried = np.concatenate([tried, true / 1.05, true / 1.25, true / 1.25**2, true / 1.25**3]) * (1 + 1e-12)
        scores = [range_errors(np.full(40, c), true, weight, bad=BAD) for c in tried[tried > 0]]
        for name in NAMES:
            higher_is_better = name.startswith(("delta", "psnr"))
            found = (max if higher_is_better else min)(score[name] for score in scores)
            if higher_is_better:
                assert best[name] >= found - 1e-12, name
            else:
                assert best[name] <= found + 1e-12, name
            if name not in ("mse", "psnr_db", "rmse"):
                assert best[name] == pytest.approx(found, abs=1e-6), name

    def test_what_lies_just_at_a_limit_is_judged_as_the_scores_do(self) -> None:
        """1 and 1.25² are each 1.25 times from 1.25, which is not below; 1 and 3 are each 50 % from 1.5, not above."""
        even = np.ones(2)
        found = best_constant_errors(np.array([1.0, 1.5625]), even)
        assert (found["delta_125"], found["delta_125_2"]) == (0.5, 1)
        assert best_constant_errors(np.array([1.0, 3.0]), even, bad=BAD)["bad_50"] == 0
        assert best_constant_errors(np.array([1.0, 3.001]), even, bad=BAD)["bad_50"] == 0.5
        length = (BadLimit(0.5, relative=False),)
        assert best_constant_errors(np.array([1.0, 2.0]), even, bad=length)["bad_abs_0.5"] == 0

    @pytest.mark.parametrize("seed", range(5))
    def test_the_median_too(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        true, weight = rng.lognormal(0.7, 0.5, 101), rng.choice(np.array([0.5, 1.0, 2.0]), 101)
        tried = np.linspace(true.min(), true.max(), 20_000)
        least = min(weighted_median(np.abs(c - true) / true, weight) for c in tried)
        assert best_constant_median(true, weight) == pytest.approx(least, abs=2e-3)
        assert best_constant_median(true, weight) <= least + 1e-9

    def test_a_view_is_compared_with_constants_on_the_very_pixels_of_each_score(self) -> None:
        truth = np.where(np.arange(12) < 6, 1.0, 5.0) * np.ones(SIZE)
        estimated = np.where(truth < 2, truth, np.nan)
        constants = score_view(estimated, truth).constants
        assert constants["best"]["mae"] == pytest.approx(2.0)
        assert constants["best"]["valid_mae"] == 0  # all that is left is one distance
        assert constants["mean"]["mae"] == pytest.approx(2.0)
        assert constants["mean"]["valid_mae"] == pytest.approx(2.0)
        assert constants["best"]["completeness"] == constants["median"]["completeness"] == 1

    @given(st.integers(0, 10**6))
    @settings(max_examples=15, deadline=None)
    def test_the_best_constant_is_never_worse_than_mean_or_median(self, seed: int) -> None:
        estimated, truth, _ = draw(seed)
        constants = score_view(estimated, truth, settings=ScoreSettings(bad=BAD)).constants
        for other in ("median", "mean"):
            for prefix in PROTOCOLS:
                for name in NAMES:
                    best, value = constants["best"][prefix + name], constants[other][prefix + name]
                    sign = -1 if name.startswith(("delta", "psnr")) else 1
                    assert np.isnan(best) or best == value or sign * best <= sign * value + 1e-9, prefix + name


class TestFit:
    def test_without_a_fit_and_without_pixels_the_factor_is_one(self) -> None:
        estimated, truth, _ = draw(0)
        assert aligning_scale(scored_pixels(estimated, truth), "none") == 1
        assert aligning_scale(scored_pixels(np.full(SIZE, np.nan), truth), "lsq") == 1

    @pytest.mark.parametrize("align", ["median", "lsq"])
    def test_a_factor_is_found_and_undone(self, align: Literal["median", "lsq"]) -> None:
        _, truth, _ = draw(1, hard=0.2)
        found = score_view(truth / 3, truth, settings=ScoreSettings(align=align))
        assert found.scale == pytest.approx(3)
        assert found.scores["valid_mae"] == pytest.approx(0, abs=1e-12)
        unfitted = score_view(truth / 3, truth)
        assert unfitted.scores["valid_abs_rel"] == pytest.approx(2 / 3)

    def test_least_squares_are_the_least(self) -> None:
        estimated, truth, _ = draw(2)
        both = scored_pixels(estimated, truth).only_valid()
        found = minimize_scalar(
            lambda s: np.sum(both.weight * (s * both.found - both.true) ** 2),
            bounds=(0.01, 10),
            method="bounded",
            options={"xatol": 1e-10},
        )
        assert aligning_scale(scored_pixels(estimated, truth), "lsq") == pytest.approx(found.x, rel=1e-5)


def test_quantiles_by_weight_are_those_of_repeated_values() -> None:
    rng = np.random.default_rng(4)
    values, times = rng.normal(size=30), rng.integers(1, 6, 30)
    repeated = np.sort(np.repeat(values, times))
    for share in (0.1, 0.5, 0.9):
        expected = repeated[int(np.ceil(share * len(repeated) - 1e-9)) - 1]
        assert weighted_quantile(values, times.astype(float), share) == expected
    assert np.isnan(weighted_quantile(np.zeros(0), np.zeros(0), 0.5))


def test_means_over_views_leave_out_what_is_no_number() -> None:
    mean = mean_scores([{"a": 1.0, "b": np.nan}, {"a": 3.0, "b": np.nan, "c": 5.0}])
    assert (mean["a"], mean["c"]) == (2, 5)
    assert np.isnan(mean["b"])


@pytest.mark.parametrize(("old", "new"), [((64, 128), (128, 256)), ((128, 256), (64, 128)), ((48, 96), (64, 128))])
def test_walls_keep_their_distance(old: tuple[int, int], new: tuple[int, int]) -> None:
    """A walk over the seam and over both poles: the box is closed, its truth known in closed form at any size."""
    found, true = resized_range(box_range(old)[0], new), box_range(new)[0]
    error = np.abs(found / true - 1)
    nearest = np.abs(resized_labels(box_range(old)[0], new) / true - 1)
    for part in (np.s_[:], np.s_[:2], np.s_[-2:], np.s_[:, [0, -1]]):
        assert np.median(error[part]) < 6e-4
    assert np.median(error) < 0.1 * np.median(nearest)
    assert error.max() <= nearest.max()  # the edges, where two walls meet


def test_nothing_lies_between_two_surfaces_and_no_hole_shrinks() -> None:
    ranges = np.where(np.arange(32) < 16, 1.0, 3.0).astype(np.float32) * np.ones((16, 1), np.float32)
    ranges[4:6, 4:6] = np.nan
    found = resized_range(ranges, (64, 128))
    assert set(np.unique(found[np.isfinite(found)])) == {1, 3}
    np.testing.assert_array_equal(np.isnan(found), np.isnan(np.repeat(np.repeat(ranges, 4, 0), 4, 1)))
    np.testing.assert_array_equal(np.nan_to_num(found), np.nan_to_num(resized_labels(ranges, (64, 128))))


def test_rolling_before_and_after_is_the_same() -> None:
    ranges = np.random.default_rng(0).uniform(1, 1.09, (8, 16)).astype(np.float32)
    for columns in (1, 5, 8):
        np.testing.assert_allclose(
            resized_range(np.roll(ranges, columns, 1), (16, 32)),
            np.roll(resized_range(ranges, (16, 32)), 2 * columns, 1),
            rtol=1e-6,
        )


def test_labels_are_those_of_the_pixel_that_holds_the_place() -> None:
    labels = np.arange(8).reshape(2, 4)
    np.testing.assert_array_equal(resized_labels(labels, (4, 8)), np.repeat(np.repeat(labels, 2, 0), 2, 1))
    np.testing.assert_array_equal(resized_labels(np.arange(32).reshape(4, 8), (2, 4))[0], [9, 11, 13, 15])


def test_other_shapes_are_told() -> None:
    with pytest.raises(UsageError, match="16×8 px cannot be compared with one of 16×9"):
        resized_range(np.ones((8, 16), np.float32), (9, 16))
