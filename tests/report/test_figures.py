"""Figures, scores, shares and residuals."""

from __future__ import annotations

from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest

from pano_mvs.report.view_cards import shares_of
from pano_mvs.results.figures import degrees, figure, median, score_tables, share, words
from pano_mvs.results.records import ScoresSummary
from pano_mvs.results.residuals import Histogram, histogram, reprojection_residuals
from pano_mvs.scene import Poses
from pano_mvs.testing.tiny_capture import TinyCapture


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0 %"),
        (1.0, "100 %"),
        (0.9999, "99.9 %"),
        (0.996, "99.6 %"),
        (0.98, "98 %"),
        (0.0123, "1.2 %"),
        (0.0001, "< 0.1 %"),
        (None, "–"),
        (float("nan"), "–"),
        (True, "–"),
    ],
)
def test_shares_are_never_rounded_up_to_all(value: float | None, text: str) -> None:
    assert share(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1234567, "1\u202f234\u202f567"),
        (0.0123456, "0.01235"),
        (1234.56, "1\u202f235"),
        (float("inf"), "–"),
        (True, "yes"),
        (None, "–"),
        ("numba", "numba"),
        ([1, 0.5], "1, 0.5"),
        ({"near_px": 2}, "near, px 2"),
    ],
)
def test_figures_have_four_digits(value: Any, text: str) -> None:
    assert figure(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.01234, "0.012°"),
        (9.96, "10°"),
        (99.4, "99°"),
        (99.6, "100°"),
        (123.4, "123°"),
        (180.0, "180°"),
        (0.0, "0°"),
        (-0.0, "0°"),
        (1.2e-6, "< 0.0001°"),
        (None, "–"),
        (float("nan"), "–"),
    ],
)
def test_angles_have_two_digits_and_no_exponent(value: float | None, text: str) -> None:
    """Those of 100° and more were shown as 1.2e+02°, those of known poses as 1.2e-06°."""
    assert degrees(value) == text


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("median_pair_error_deg", "median pair error, °"),
        ("auc_0.5_deg", "AUC at 0.5°"),
        ("points", "points"),
        ("w_mae", "mean error on the sphere"),
        ("s", "s"),
    ],
)
def test_names_become_words(name: str, text: str) -> None:
    assert words(name) == text


def test_the_median_leaves_out_what_is_no_number() -> None:
    assert median([3, None, float("nan"), 1.0, "x", 2]) == 2
    assert median([1, 2]) == 1.5
    assert median([None]) is None


def test_a_score_stands_beside_what_a_constant_scores() -> None:
    views: dict[str, dict[str, float | None]] = {
        "a": {"psnr_db": 30.0, "ause": 0.02, "constant_psnr_db": 18.0, "best_constant_psnr_db": 19.0},
        "b": {"psnr_db": 20.0, "best_constant_psnr_db": 10.0},
        "c": {"psnr_db": None},
    }
    tables = score_tables(ScoresSummary(poses={"of": 3}, views=views, notes=("a note",)))
    assert tables["columns"] == ["psnr_db", "ause"]
    assert tables["views"] == [("a", ["30 (19)", "0.02"]), ("b", ["20 (10)", "–"]), ("c", ["–", "–"])]
    assert tables["median"] == ["25 (14.5)", "0.02"]
    assert "best one for each score" in tables["notes"][0]
    assert tables["notes"][1:] == ["a note"]
    assert score_tables(ScoresSummary(views={"a": {"psnr_db": 1.0}})) == {
        "poses": [],
        "columns": ["psnr_db"],
        "views": [("a", ["1"])],
        "median": [],
        "notes": [],
    }


def test_residuals_are_the_noise_of_the_bearings(tiny: TinyCapture) -> None:
    """2e-4 rad of noise along each axis: across the ray it has two components, a Rayleigh distribution."""
    residuals = reprojection_residuals(tiny.whole(Poses))
    assert residuals is not None
    expected_deg = np.rad2deg(2e-4) * np.sqrt(2 * np.log(2))
    assert residuals.overall.median_deg == pytest.approx(expected_deg, rel=0.08)
    assert residuals.overall.total == 4 * 240 == sum(residuals.overall.counts)
    assert set(residuals.views) == set(tiny.names)
    for middle, p95, count in residuals.views.values():
        assert middle == pytest.approx(expected_deg, rel=0.2)
        assert middle < p95
        assert count == 240
    assert not residuals.sampled


def test_a_camera_that_is_turned_stands_out(tiny: TinyCapture) -> None:
    poses = tiny.whole(Poses)
    angle_rad = np.deg2rad(1.0)
    turn = np.array([[np.cos(angle_rad), 0, np.sin(angle_rad)], [0, 1, 0], [-np.sin(angle_rad), 0, np.cos(angle_rad)]])
    rotations, translations = poses.rotations.copy(), poses.translations.copy()
    rotations[2], translations[2] = turn @ rotations[2], turn @ translations[2]
    residuals = reprojection_residuals(replace(poses, rotations=rotations, translations=translations))
    assert residuals is not None
    medians = {name: median for name, (median, *_) in residuals.views.items()}
    assert max(medians, key=medians.__getitem__) == tiny.names[2]
    assert 0.5 < medians[tiny.names[2]] <= 1.01


def test_without_tracks_there_are_no_residuals(tiny: TinyCapture) -> None:
    bare = Poses.without_points({}, frame="", scale="", metric=False)
    assert reprojection_residuals(bare) is None


def test_every_value_is_in_one_bin_and_the_largest_in_the_last() -> None:
    values = np.concatenate([np.full(950, 0.01), [5.0, np.nan, np.inf]])
    found, zeros = histogram(values), histogram([0.0, 0.0])
    assert found is not None
    assert zeros is not None
    assert sum(found.counts) == found.total == 951
    assert found.counts[-1] == 1
    assert found.median_deg == pytest.approx(0.01)
    assert histogram([]) is None
    assert zeros.median_at == 0
    assert histogram([np.nan]) is None


def test_shares_are_of_the_sphere_and_not_of_the_picture() -> None:
    """Of the rows of a quarter of the picture's height at a pole, 1 − cos 45° over 2 is of the sphere."""
    confidence = np.full((256, 512), 200, np.uint8)
    confidence[:64] = 0
    confidence[-64:] = 30
    shares = shares_of(confidence)
    cap = (1 - np.cos(np.pi / 4)) / 2
    assert (shares.invalid, shares.filled) == pytest.approx((cap, cap), abs=1e-4)
    assert shares.consistent == pytest.approx(1 - 2 * cap, abs=1e-4)
    assert sum(astuple(shares)) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize(
    ("value", "name"),
    [
        (0, "invalid"),
        (1, "filled"),
        (63, "filled"),
        (64, "weak"),
        (127, "weak"),
        (128, "consistent"),
        (255, "consistent"),
    ],
)
def test_classes_end_where_the_confidence_says(value: int, name: str) -> None:
    assert getattr(shares_of(np.full((8, 16), value, np.uint8)), name) == pytest.approx(1)


@pytest.mark.parametrize("rows", [512, 700, 2048])
def test_large_maps_are_sampled_without_a_bias(rows: int) -> None:
    confidence = np.zeros((rows, 16), np.uint8)
    confidence[: rows // 2] = 255
    assert shares_of(confidence).consistent == pytest.approx(0.5, abs=0.01)


def test_what_is_masked_is_not_missed() -> None:
    confidence = np.full((64, 128), 200, np.uint8)
    confidence[32:] = 0
    mask = np.ones((64, 128), bool)
    mask[48:] = False
    shares = shares_of(confidence, mask)
    assert shares.masked > 0
    assert shares.complete == pytest.approx(0.5 / (1 - shares.masked), abs=1e-3)
    assert shares.complete == shares.confirmed
    assert shares_of(np.zeros((4, 8), np.uint8), np.zeros((4, 8), bool)).complete == 0


@pytest.mark.parametrize("largest", [1, 2, 3, 5, 6, 9, 10, 11, 19, 20, 21, 49, 51, 99, 101, 4321, 1_000_000])
def test_the_axis_of_counts_has_few_round_ticks_and_reaches_the_largest(largest: int) -> None:
    found = Histogram((0, largest), 1.0, 0.1, 0.2, largest).count_ticks
    step = found[1] - found[0]
    assert found[0] == 0
    assert set(np.diff(found)) == {step}
    assert found[-2] < largest <= found[-1]
    assert 2 <= len(found) <= 6
    assert str(step).rstrip("0") in ("1", "2", "5")
