"""Numbers as people read them."""

from __future__ import annotations

from typing import Any

import pytest

from pano_mvs.results.figures import degrees, duration, figure, median, score_tables, share, words
from pano_mvs.results.records import ScoresSummary


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
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (9.94, "9.9 s"),
        (9.96, "10 s"),
        (59.6, "1 min 00 s"),
        (187.2, "3 min 07 s"),
        (7620, "2 h 07 min"),
        (None, "–"),
    ],
)
def test_durations_are_those_of_a_clock(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text


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
