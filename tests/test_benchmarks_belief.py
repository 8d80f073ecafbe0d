"""The model of evidence recovers what generated evidence says, and never counts a measurement against its sign."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.algorithms.poses.verification.verify_poses import verified_group
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.benchmarks.belief.evidence import camera_evidence
from tests.benchmarks.belief.fitting import (
    SIGNS,
    Cameras,
    Outcome,
    area_under_roc,
    calibration_error,
    cameras_of,
    fit,
    left_out,
    probabilities,
    read_table,
    write_table,
)
from tests.benchmarks.belief.model import Model, steps_behind
from tests.benchmarks.belief.refit import doubted


def drawn(count: int, rng: np.random.Generator) -> Cameras:
    """Return cameras whose chance to be right depends on two of three measurements."""
    good, against, noise = (rng.normal(size=count) for _ in range(3))
    missing = rng.random(count) < 0.2
    logit = 1.5 + 2 * np.clip(good, -2, 2) - 1.5 * np.clip(against, -2, 2) - missing
    right = rng.random(count) < 1 / (1 + np.exp(-logit))
    columns = {"ratio": good, "place_rival": against, "height": np.where(missing, np.nan, noise)}
    family = rng.choice(["a", "b", "c"], count)
    return Cameras(columns, right, np.zeros(count, np.bool_), family, family)


TABLE = Path(__file__).parent / "benchmarks" / "belief" / "evidence.csv"
CHOSEN = {"ratio": 1, "place_rival": -1, "height": -1}


def test_families_that_were_left_out_are_calibrated() -> None:
    cameras = drawn(3000, np.random.default_rng(0))
    found = left_out(cameras, signs=CHOSEN)
    assert calibration_error(found, cameras.right) < 0.04
    assert area_under_roc(found, cameras.right) > 0.85


def test_the_stored_evidence_is_calibrated_and_says_more_than_the_rules(tmp_path: Path) -> None:
    """Rooms that look alike in everything are left out: no evidence can be for or against their cameras."""
    cameras = read_table(TABLE)
    write_table(tmp_path / "again.csv", cameras)
    assert (tmp_path / "again.csv").read_text() == TABLE.read_text()
    cameras = cameras[cameras.family != "twin_house"]
    found = left_out(cameras)
    assert calibration_error(found, cameras.right) < 0.04
    assert area_under_roc(found, cameras.right) > 0.85
    rules, model = (Outcome.of(cameras.right, one) for one in (cameras.doubted, doubted(found)))
    assert model.right_doubted < 0.6 * rules.right_doubted
    assert model.wrong_silent < 1.1 * rules.wrong_silent


def test_a_measurement_only_counts_the_way_of_its_sign() -> None:
    cameras = drawn(2000, np.random.default_rng(1))
    model = fit(cameras, signs={**CHOSEN, "ratio": -1})
    assert "ratio" not in model.terms or not any(model.terms["ratio"].losses)
    better = fit(cameras, signs=CHOSEN)
    row = {"ratio": 0.0, "place_rival": 0.0, "height": 0.0}
    chances = [better.probability({**row, "ratio": value}) for value in np.linspace(-4, 4, 30)]
    assert np.all(np.diff(chances) >= 0)
    assert chances[-1] - chances[0] > 0.5


def test_a_missing_measurement_is_never_better_than_the_best() -> None:
    model = fit(drawn(2000, np.random.default_rng(2)), signs=CHOSEN)
    best = {"ratio": 9.0, "place_rival": -9.0, "height": -9.0}
    assert model.probability({**best, "height": np.nan}) < model.probability(best)
    assert all(one <= 0 for one in model.contributions({}).values())


def test_steps_count_from_the_best_knot() -> None:
    behind = steps_behind(np.array([-1.0, 0.0, 1.5, 2.0, 3.0, np.nan]), (0.0, 1.0, 2.0))
    assert behind.tolist() == [[1, 1, 0], [1, 1, 0], [0, 0.5, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1]]


def test_a_model_is_the_same_from_its_file() -> None:
    cameras = drawn(500, np.random.default_rng(3))
    model = fit(cameras, signs=CHOSEN)
    again = Model.from_json(json.loads(json.dumps(model.to_json())))
    np.testing.assert_array_equal(probabilities(again, cameras), probabilities(model, cameras))
    row = {name: float(values[0]) for name, values in cameras.columns.items()}
    assert again.probability(row) == pytest.approx(probabilities(model, cameras)[0])


def test_the_costs_decide_what_is_doubted() -> None:
    assert doubted(np.array([0.1, 0.83, 0.84, 1.0])).tolist() == [True, True, False, False]
    outcome = Outcome.of(np.array([True, True, False, False]), np.array([True, False, True, False]))
    assert (outcome.right, outcome.wrong, outcome.right_doubted, outcome.wrong_silent) == (2, 2, 1, 1)


@pytest.mark.slow
def test_every_measurement_that_is_fitted_is_measured() -> None:
    tiny = tiny_capture(Variant(size_hw=(128, 256)))
    poses = Poses.without_points(dict(zip(tiny.names, tiny.poses, strict=True)), frame="x", scale="x", metric=True)
    whole = np.ones((128, 256), np.bool_)
    loaded = {name: (image, whole) for name, image in zip(tiny.names, tiny.pictures, strict=True)}
    group = verified_group(
        poses, loaded.__getitem__, features=tiny.each(Features), two_views=tiny.each(TwoView), correct=False
    )
    evidence = camera_evidence(group)
    assert set(evidence) == set(tiny.names)
    for row in evidence.values():
        assert row.keys() >= SIGNS.keys()
        assert row["ratio"] > 0.7
        assert row["explained"] == pytest.approx(1.0)
        assert row["residual_deg"] < 0.5
    without = camera_evidence(verified_group(poses, loaded.__getitem__, features={}, two_views={}, correct=False))
    assert all(np.isnan(row["explained"]) and row["alarms_best"] == 0 for row in without.values())
    about = {"family": "x", "seed": 1, "variant": "asked", "right": True, "doubted": False}
    cameras = cameras_of([{"cameras": [{**about, "evidence": {**row, "height": None}} for row in evidence.values()]}])
    assert np.isnan(cameras.columns["height"]).all()
    assert len(cameras.right) == len(tiny.names)
