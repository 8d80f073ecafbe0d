"""The model of evidence recovers what generated evidence says, and never counts a measurement against its sign."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.algorithms.logistic import Model, Term, steps_behind
from pano_mvs.algorithms.poses.verification.belief.coefficients import FITTED
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tools.benchmarks.belief import fitting
from tools.benchmarks.belief.fitting import (
    SIGNS,
    Cameras,
    Outcome,
    area_under_roc,
    calibration_error,
    fit,
    left_out,
    most_likely,
    read_table,
    write_table,
)
from tools.benchmarks.belief.refit import decidable, doubted, read, source_of
from tools.benchmarks.belief.tours import measure_tour, verified_again


def drawn(count: int, rng: np.random.Generator) -> Cameras:
    """Return cameras whose chance to be right depends on two of three measurements."""
    good, against, noise = (rng.normal(size=count) for _ in range(3))
    missing = rng.random(count) < 0.2
    logit = 1.5 + 2 * np.clip(good, -2, 2) - 1.5 * np.clip(against, -2, 2) - missing
    right = rng.random(count) < 1 / (1 + np.exp(-logit))
    columns = {"ratio": good, "place_rival": against, "repeats": np.where(missing, np.nan, noise)}
    family = rng.choice(["a", "b", "c"], count)
    return Cameras(columns, right, np.zeros(count, np.bool_), family, family)


TABLE, LEARNED = (Path(fitting.__file__).with_name(name) for name in ("evidence.csv", "learned.csv"))
CHOSEN = {"ratio": 1, "place_rival": -1, "repeats": -1}


def test_families_that_were_left_out_are_calibrated() -> None:
    cameras = drawn(3000, np.random.default_rng(0))
    found = left_out(cameras, signs=CHOSEN)
    assert calibration_error(found, cameras.right) < 0.04
    assert area_under_roc(found, cameras.right) > 0.85


def test_all_families_of_a_place_are_left_out_together() -> None:
    cameras = drawn(600, np.random.default_rng(4))
    large = (cameras.family == "a") & (np.arange(600) % 2 == 0)
    cameras = replace(cameras, family=np.where(large, "a/large", cameras.family))
    others = replace(cameras, right=np.where(large, ~cameras.right, cameras.right))
    mine = cameras.place == "a"
    np.testing.assert_array_equal(*(left_out(each, signs=CHOSEN)[mine] for each in (cameras, others)))


@pytest.mark.parametrize("table", [TABLE, LEARNED])
def test_a_table_is_the_same_from_its_file(table: Path, tmp_path: Path) -> None:
    write_table(tmp_path / "again.csv", read_table(table))
    assert (tmp_path / "again.csv").read_text() == table.read_text()


@pytest.mark.slow
def test_the_stored_evidence_is_calibrated_and_says_more_than_what_was_doubted_when_it_was_measured() -> None:
    cameras = decidable(read([TABLE, LEARNED]))
    again = fit(cameras).probabilities(cameras.columns)
    np.testing.assert_allclose(FITTED.probabilities(cameras.columns), again, atol=0.01)
    plain = decidable(read_table(TABLE))
    found = left_out(plain)
    assert calibration_error(found, plain.right) < 0.03
    assert area_under_roc(found, plain.right) > 0.88
    before, model = (Outcome.of(plain.right, one) for one in (plain.doubted, doubted(found)))
    costs = [one.right_doubted + 5 * one.wrong_silent for one in (before, model)]
    assert costs[1] < costs[0]
    assert FITTED.probability({}) == pytest.approx(cameras.right.mean(), abs=0.02)


@pytest.mark.slow
def test_tours_that_were_left_out_are_judged_better_with_their_links_than_without() -> None:
    cameras = decidable(read([TABLE, LEARNED]))
    tours = cameras[np.isin(cameras.place, np.unique(read_table(LEARNED).place))]

    def judged(signs: dict[str, int]) -> Outcome:
        found = np.full(len(tours.right), np.nan)
        for some in np.array_split(np.unique(tours.place), 4):
            mine = np.isin(tours.place, some)
            model = fit(cameras[~np.isin(cameras.place, some)], signs=signs)
            found[mine] = model.probabilities(tours[mine].columns)
        return Outcome.of(tours.right, doubted(found))

    links = {"linked", "links_contradicting"}
    without, model = judged({name: sign for name, sign in SIGNS.items() if name not in links}), judged(SIGNS)
    assert model.right_doubted < 0.7 * without.right_doubted
    assert model.wrong_silent <= without.wrong_silent


def test_a_measurement_only_counts_the_way_of_its_sign() -> None:
    cameras = drawn(2000, np.random.default_rng(1))
    model = fit(cameras, signs={**CHOSEN, "ratio": -1})
    assert "ratio" not in model.terms or not any(model.terms["ratio"].losses)
    better = fit(cameras, signs=CHOSEN)
    row = {"ratio": 0.0, "place_rival": 0.0, "repeats": 0.0}
    chances = [better.probability({**row, "ratio": value}) for value in np.linspace(-4, 4, 30)]
    assert np.all(np.diff(chances) >= 0)
    assert chances[-1] - chances[0] > 0.5


def test_a_missing_measurement_is_never_better_than_the_best() -> None:
    model = fit(drawn(2000, np.random.default_rng(2)), signs=CHOSEN)
    best = {"ratio": 9.0, "place_rival": -9.0, "repeats": -9.0}
    assert model.probability({**best, "repeats": np.nan}) < model.probability(best)
    assert all(one <= 0 for one in model.contributions({}).values())


def test_a_measurement_counts_in_proportion_to_another_one() -> None:
    model = Model(2.0, {"likeness": Term((0.0, 1.0), (4.0,), 1.0, ("pairs_contradicting", 0.2))})
    cost = {
        against: -model.contributions({"likeness": 0.0, "pairs_contradicting": against})["likeness"]
        for against in (0.0, 0.05, 0.2, 0.9, np.nan)
    }
    assert [*cost.values()] == pytest.approx([0.0, 1.0, 4.0, 4.0, 4.0])
    assert model.contributions({"pairs_contradicting": 0.1})["likeness"] == pytest.approx(-0.5)
    columns = {"likeness": np.zeros(2), "pairs_contradicting": np.array([0.0, 1.0])}
    assert model.log_odds(columns).tolist() == [2.0, -2.0]


def test_what_counts_only_beside_something_else_is_fitted_where_it_counts() -> None:
    rng = np.random.default_rng(5)
    good, against = rng.normal(size=4000), rng.choice([0.0, 0.3], 4000)
    logit = np.where(against > 0, 2 * np.clip(good, -2, 2), 2.0)
    right = (rng.random(4000) < 1 / (1 + np.exp(-logit))).astype(np.float64)
    columns, knots = {"likeness": good, "pairs_contradicting": against}, {"likeness": (-1.0, 0.0, 1.0)}
    full_from = {"likeness": ("pairs_contradicting", 0.2)}
    model = most_likely(columns, right, np.ones(4000), knots=knots, penalty=1.0, full_from=full_from)
    chances = [model.probability({"likeness": -1.0, "pairs_contradicting": each}) for each in (0.0, 0.3)]
    assert chances[0] > 0.8
    assert chances[1] < 0.25


def test_steps_count_from_the_best_knot() -> None:
    behind = steps_behind(np.array([-1.0, 0.0, 1.5, 2.0, 3.0, np.nan]), (0.0, 1.0, 2.0))
    assert behind.tolist() == [[1, 1, 0], [1, 1, 0], [0, 0.5, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1]]


def test_a_model_is_the_same_from_its_file(tmp_path: Path) -> None:
    model = fit(drawn(500, np.random.default_rng(3)), signs=CHOSEN)
    (tmp_path / "coefficients.py").write_text(source_of(model))
    assert runpy.run_path(str(tmp_path / "coefficients.py"))["FITTED"] == model


def test_outcomes_count_both_errors() -> None:
    outcome = Outcome.of(np.array([True, True, False, False]), np.array([True, False, True, False]))
    assert (outcome.right, outcome.wrong, outcome.right_doubted, outcome.wrong_silent) == (2, 2, 1, 1)


@pytest.mark.slow
def test_every_measurement_of_a_table_is_measured() -> None:
    tiny = tiny_capture(Variant(size_hw=(128, 256)))
    poses = Poses.without_points(dict(zip(tiny.names, tiny.poses, strict=True)), frame="x", scale="x", metric=True)
    whole = np.ones((128, 256), np.bool_)
    loaded = {name: (image, whole) for name, image in zip(tiny.names, tiny.pictures, strict=True)}
    group = verify_poses(
        poses, loaded.__getitem__, features=tiny.each(Features), two_views=tiny.each(TwoView), correct=False
    )
    assert [*group.evidence] == [*tiny.names]
    for row in group.evidence.values():
        assert row.keys() == SIGNS.keys()
        assert (row["ratio"] or 0) > 0.7
        assert (row["agreeing"] or 0) > 1
    without = verify_poses(poses, loaded.__getitem__, correct=False)
    for row in without.evidence.values():
        assert row["agreeing"] is None
        assert (row["ratio"] or 0) > 0.7


@pytest.mark.slow
def test_tours_are_measured_with_other_samples(tmp_path: Path) -> None:
    tiny = tiny_capture(Variant(size_hw=(128, 256)))
    (tmp_path / "images").mkdir()
    truth = {}
    for name, pose, picture in zip(tiny.names, tiny.poses, tiny.pictures, strict=True):
        cv2.imwrite(str(tmp_path / "images" / name), picture[..., ::-1])
        truth[name] = {
            "yaw_deg": 0.0,
            "camera_from_world": pose.rotation.tolist(),
            "position_m": pose.center.tolist(),
        }
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    features, views = tiny.each(Features), tiny.each(TwoView)
    again = verified_again(features, views, seed=5)
    assert again.keys() == views.keys()
    rows = measure_tour(tmp_path, features, again, seed=5)
    assert {row["name"] for row in rows} <= {*tiny.names}
    assert all(row["right"] and row["seed"] == 5 for row in rows)
    assert {*rows[0]["evidence"]} == {*SIGNS}
    assert rows[0]["evidence"]["linked"] > 1
