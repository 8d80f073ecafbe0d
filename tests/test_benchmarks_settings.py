"""The search for settings measures what it says, and chooses only what holds on every place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.scene import RangeMap
from pano_mvs.testing.scenes import weak_room
from tests.benchmarks.captures import scene_capture
from tests.benchmarks.dense_chain import DenseChain
from tests.benchmarks.depth.choice import left_out_gain, worth_of
from tests.benchmarks.depth.place_scores import PlaceScores, kept_at_precision, score_place
from tests.benchmarks.depth.places import SYNTHETIC, Place, places_of
from tests.benchmarks.depth.settings_search import SETTINGS, Search, by_place, line
from tests.benchmarks.depth.stored_chain import StoredChain

SMALL = ["depth.planes=32", "depth.near=1.0", "depth.far=6.0"]


def test_pixels_are_kept_until_precision_falls() -> None:
    confidence = np.array([200, 180, 160, 140], np.uint8)
    right = np.array([True, True, False, False])
    assert kept_at_precision(confidence, right, np.ones(4), precision=1.0) == 2
    # Half of the third pixel: (2 + 0) / 2.5 = 0.8.
    assert kept_at_precision(confidence, right, np.ones(4), precision=0.8) == pytest.approx(2.5)
    assert kept_at_precision(confidence, right, np.ones(4), precision=0.5) == 4


def test_the_largest_share_counts_even_if_the_surest_pixels_are_wrong() -> None:
    confidence = np.array([200, 180, 160, 140], np.uint8)
    right = np.array([False, True, True, True])
    assert kept_at_precision(confidence, right, np.ones(4), precision=0.75) == 4
    assert kept_at_precision(confidence, right, np.ones(4), precision=0.9) == 0


def test_ranges_in_the_sky_are_wrong() -> None:
    truth = np.full((8, 16), 2.0, np.float32)
    truth[:4] = np.nan
    perfect = RangeMap(truth, np.where(np.isfinite(truth), 200, 0).astype(np.uint8))
    scores = score_place([perfect], [perfect], [truth])
    assert (scores.delta, scores.kept, scores.surface_f) == pytest.approx((100, 100, 100))
    everywhere = RangeMap(np.full((8, 16), 2.0, np.float32), np.full((8, 16), 200, np.uint8))
    scores = score_place([everywhere], [everywhere], [truth])
    assert (scores.delta, scores.kept, scores.surface_f) == pytest.approx((100, 0, 100 * 2 / 3))
    assert (scores.confirmed, scores.confirmed_delta) == pytest.approx((200, 50))


def test_a_setting_that_loses_anywhere_is_not_chosen() -> None:
    default = {"a": 50.0, "b": 60.0, "c": 70.0}
    chosen = worth_of(default, {"a": 51.0, "b": 59.9, "c": 70.5})
    assert (chosen.is_chosen, chosen.winners, chosen.worst, chosen.best) == (True, 2, "b", "a")
    lost = worth_of(default, {"a": 55.0, "b": 58.0, "c": 75.0})
    assert (lost.mean > chosen.mean, lost.is_chosen, lost.folds) == (True, False, 2)
    # One place alone wins: without it, there is no reason to choose the setting.
    lucky = worth_of(default, {"a": 55.0, "b": 59.9, "c": 69.9})
    assert (lucky.mean > 0, lucky.is_chosen) == (True, False)


def test_the_search_is_worth_what_unseen_places_gain() -> None:
    default = dict.fromkeys("abc", 50.0)
    steady = worth_of(default, {"a": 51.0, "b": 51.0, "c": 51.0})
    lucky = worth_of(default, {"a": 58.0, "b": 49.0, "c": 49.0})
    assert left_out_gain({"steady": steady}) == 1
    # Without b or c, `lucky` looks best and loses there; without a, `steady` does.
    assert left_out_gain({"steady": steady, "lucky": lucky}) == pytest.approx((1 - 1 - 1) / 3)
    assert left_out_gain({"worse": worth_of(default, dict.fromkeys("abc", 40.0))}) == 0


def test_a_stored_chain_gives_the_maps_of_the_chain(tmp_path: Path) -> None:
    capture = scene_capture(weak_room(views=3), tmp_path / "scene", width=64)
    names = list(capture.panoramas)
    plain = DenseChain("known_poses", overrides=SMALL).run(capture).range_maps["smooth"]
    for _ in range(2):  # computed, then read
        chain = StoredChain("known_poses", overrides=SMALL, store=tmp_path / "maps")
        run = chain.run(capture, label="room", references=names[:1])
        assert {stage: list(maps) for stage, maps in run.range_maps.items()} == {
            "depth": names,
            "checked": names[:1],
            "sky": names[:1],
            "smooth": names[:1],
        }
        np.testing.assert_array_equal(run.range_maps["smooth"][names[0]].range, plain[names[0]].range)
    assert len(list((tmp_path / "maps").iterdir())) == len(names)
    other = StoredChain("known_poses", overrides=[*SMALL, "smooth.smoothness=2"])
    assert (other.key("depth"), other.key()) == (chain.key("depth"), other.key("smooth"))
    assert other.key() != chain.key()


def test_scores_are_measured_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = Place("weak_room", 64, 2, arguments=(("seed", 1),))
    setting = " ".join(SMALL)
    results = tmp_path / "scores.json"
    search = Search("known_poses", [place], scratch=tmp_path, results=results, label="before")
    table = search.scores(setting)
    assert list(by_place(table, "delta")) == ["weak_room"]
    monkeypatch.setattr("tests.benchmarks.depth.settings_search.measure", None)
    again = Search("known_poses", [place], scratch=tmp_path, results=results, label="after")
    assert again.scores(setting) == again.labelled(setting, "before") == table
    assert again.labelled("", "before") == {}
    assert Search("fast", [place], scratch=tmp_path, results=results, label="").labelled(setting, "before") == {}


def test_the_table_shows_gains() -> None:
    truth = np.full((8, 16), 2.0, np.float32)
    confidence = np.full((8, 16), 200, np.uint8)
    wrong = truth.copy()
    wrong[:, :8] = 3.0
    half, perfect = (_scored(RangeMap(ranges, confidence), truth) for ranges in (wrong, truth))
    default, better = {"a-64-2": half, "b-64-2": half}, {"a-64-2": perfect, "b-64-2": perfect}
    row = line("x", default, better)
    assert "| +50.00 |" in row
    assert "2 of 2" in row
    assert row.endswith("| yes |")


def _scored(found: RangeMap, truth: NDArray[np.float32]) -> PlaceScores:
    return score_place([found], [found], [truth])


def test_places_are_of_every_kind() -> None:
    places = places_of([Path("one"), Path("two")])
    assert len({place.place for place in places}) >= 12
    assert len({place.key for place in places}) == len(places)
    assert {place.views - 1 for place in places} >= {2, 3, 4, 8}
    assert {place.place for place in SYNTHETIC} >= {"courtyard", "poles", "corridor", "stairs"}
    assert len(set(SETTINGS)) == len(SETTINGS)
